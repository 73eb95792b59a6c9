"""`python benchmarks/render.py`: the comparison with other implementations, as Markdown and as a picture.

Reads the JSON that `pytest benchmarks/` wrote. Every ratio is taken between
implementations measured in that one run on that one machine; nothing is
measured here.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from smcrypto.errors import MissingDependency

OURS = "smcrypto"


@dataclass(frozen=True, slots=True)
class Timing:
    """One implementation's median in one group: seconds for one call, bytes it processed (0: no rate)."""

    group: str
    implementation: str
    median: float
    size: int


@dataclass(frozen=True, slots=True)
class Comparison:
    """Our timing of one group beside each peer's; `ratio[peer]` above 1 means ours is faster."""

    group: str
    ours: Timing
    peers: tuple[Timing, ...]

    @property
    def ratios(self) -> dict[str, float]:
        return {peer.implementation: peer.median / self.ours.median for peer in self.peers}


def timings(report: dict[str, Any]) -> list[Timing]:
    """The timings of a pytest-benchmark report that say whose implementation ran."""
    return [
        Timing(
            group=entry["group"] or entry["name"],
            implementation=entry["extra_info"]["implementation"],
            median=entry["stats"]["median"],
            size=int(entry["extra_info"].get("bytes", 0)),
        )
        for entry in report["benchmarks"]
        if "implementation" in entry.get("extra_info", {})
    ]


def comparisons(found: Sequence[Timing]) -> list[Comparison]:
    """Groups in the order they ran; those without a timing of ours are left out."""
    result = []
    for group in dict.fromkeys(timing.group for timing in found):
        members = [timing for timing in found if timing.group == group]
        ours = [timing for timing in members if timing.implementation == OURS]
        if ours:
            peers = tuple(t for t in members if t.implementation != OURS)
            result.append(Comparison(group, ours[0], peers))
    return result


def duration(seconds: float) -> str:
    """Three significant digits with the unit that suits.

    >>> duration(8.51e-5), duration(3.4), duration(0.25)
    ('85.1 µs', '3.40 s', '250 ms')
    """
    units = (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6), ("ns", 1e-9))
    unit, scale = next((entry for entry in units if seconds >= entry[1]), units[-1])
    value = seconds / scale
    return f"{value:.0f} {unit}" if value >= 99.95 else f"{value:#.3g} {unit}"


def rate(timing: Timing) -> str:
    return f"{timing.size / timing.median / 1e6:.3g} MB/s" if timing.size else "—"


def markdown(report: dict[str, Any]) -> str:
    """The comparison as a Markdown table under a line that names machine, versions and engines."""
    machine = report["machine_info"]
    lines = [
        f"Measured {report['datetime'][:10]} on {machine['cpu'].get('brand_raw', machine['machine'])}, "
        f"{machine['python_implementation']} {machine['python_version']}, "
        f"{machine.get('engines', 'engines unknown')}. Medians; every ratio is from this one run.",
        "",
        "| what | smcrypto | rate | beside | ratio |",
        "| --- | ---: | ---: | --- | ---: |",
    ]
    for comparison in comparisons(timings(report)):
        first = [comparison.group, duration(comparison.ours.median), rate(comparison.ours)]
        for peer in comparison.peers or (None,):
            beside = f"{peer.implementation} {duration(peer.median)}" if peer else "—"
            ratio = f"{comparison.ratios[peer.implementation]:.3g}×" if peer else "—"
            lines.append("| " + " | ".join([*first, beside, ratio]) + " |")
            first = ["", "", ""]
    return "\n".join(lines) + "\n"


def picture(report: dict[str, Any], path: Path) -> None:
    """Draw every ratio as a bar on a logarithmic axis, 1 being the peer's own speed (SVG, PNG, PDF by suffix)."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingDependency("drawing the comparison needs the package matplotlib") from None
    rows = [
        (f"{comparison.group}  vs {peer}", ratio)
        for comparison in comparisons(timings(report))
        for peer, ratio in comparison.ratios.items()
    ]
    figure = Figure(figsize=(9, 1.2 + 0.26 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    axes.barh(
        [label for label, _ in rows],
        [ratio for _, ratio in rows],
        color=["#2a6f97" if ratio >= 1 else "#c08552" for _, ratio in rows],
    )
    for index, (_, ratio) in enumerate(rows):
        axes.annotate(f"{ratio:.3g}×", (ratio, index), xytext=(4, 0), textcoords="offset points", va="center",
                      fontsize=8)
    axes.set_xscale("log")
    axes.axvline(1, color="black", linewidth=0.8)
    axes.invert_yaxis()
    axes.margins(x=0.15, y=0.01)
    axes.tick_params(axis="y", labelsize=8)
    axes.set_xlabel("times as fast as the peer (logarithmic; right of the line: faster)")
    figure.savefig(path)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python benchmarks/render.py",
        description="Render the results of `pytest benchmarks/` as Markdown and as a picture.",
    )
    parser.add_argument("results", nargs="?", type=Path, default=Path("benchmarks/results.json"),
                        help="JSON written by `pytest benchmarks/` (default: %(default)s)")
    parser.add_argument("--markdown", type=Path, help="write the table here instead of to stdout")
    parser.add_argument("--picture", type=Path, help="draw the ratios into this .svg, .png or .pdf")
    options = parser.parse_args(arguments)
    try:
        report = json.loads(options.results.read_text(encoding="utf-8"))
        table = markdown(report)
    except (OSError, ValueError, KeyError, TypeError) as error:
        print(f"cannot read {options.results}: {error!r}; run `pytest benchmarks/` first", file=sys.stderr)
        return 1
    try:
        if options.picture is not None:
            picture(report, options.picture)
        if options.markdown is not None:
            options.markdown.write_text(table, encoding="utf-8")
        else:
            print(table, end="")
    except (OSError, MissingDependency) as error:
        print(f"render: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
