"""`python benchmarks/render.py`: what a report of pytest-benchmark becomes, and what it does with one that is none."""

from __future__ import annotations

import importlib.util
import json
import os
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import smcrypto
from smcrypto import MissingDependency

ROOT = Path(__file__).resolve().parents[2]
RENDER = ROOT / "benchmarks" / "render.py"
_SPEC = importlib.util.spec_from_file_location("benchmarks_render", RENDER)
assert _SPEC is not None and _SPEC.loader is not None
bench = importlib.util.module_from_spec(_SPEC)
sys.modules["benchmarks_render"] = bench
_SPEC.loader.exec_module(bench)


def entry(group: str | None, implementation: str | None, median: float, size: int | None = None) -> dict[str, Any]:
    extra: dict[str, Any] = {}
    if implementation is not None:
        extra["implementation"] = implementation
    if size is not None:
        extra["bytes"] = size
    return {"name": f"test[{group}]", "group": group, "stats": {"median": median}, "extra_info": extra}


@pytest.fixture
def report() -> dict[str, Any]:
    """One bulk row with two peers, one without a size, one that only peers ran, and one that says not whose it is."""
    return {
        "datetime": "2026-01-31T12:00:00+00:00",
        "machine_info": {
            "cpu": {"brand_raw": "A processor"}, "machine": "x86_64", "python_implementation": "CPython",
            "python_version": "3.11.7", "engines": "SM2 by python, SM3 by openssl, SM4 by python",
        },
        "benchmarks": [
            entry("SM4-CTR 1 MiB", "gmssl", 3.4, 1 << 20),
            entry("SM4-CTR 1 MiB", "smcrypto", 0.017, 1 << 20),
            entry("SM2 sign", "smcrypto", 2e-4),
            entry("SM4-CTR 1 MiB", "OpenSSL", 0.0085, 1 << 20),
            entry("elsewhere", "gmssl", 1.0),
            entry(None, "smcrypto", 5e-9),
            entry("unknown", None, 1.0),
        ],
    }  # fmt: skip


@pytest.fixture
def results(report: dict[str, Any], tmp_path: Path) -> Path:
    path = tmp_path / "results.json"
    path.write_text(json.dumps(report))
    return path


def test_ratios_are_how_many_times_as_fast_we_are(report: dict[str, Any]) -> None:
    found = {comparison.group: comparison for comparison in bench.comparisons(bench.timings(report))}
    assert list(found) == ["SM4-CTR 1 MiB", "SM2 sign", "test[None]"]
    assert found["SM4-CTR 1 MiB"].ratios == pytest.approx({"gmssl": 200, "OpenSSL": 0.5})
    assert found["SM2 sign"].ratios == {}


def test_the_table_names_machine_engine_rate_and_every_peer(report: dict[str, Any]) -> None:
    assert bench.markdown(report).splitlines() == [
        "Measured 2026-01-31 on A processor, CPython 3.11.7, SM2 by python, SM3 by openssl, SM4 by python. Medians; "
        "every ratio is from this one run.",
        "",
        "| what | smcrypto | rate | beside | ratio |",
        "| --- | ---: | ---: | --- | ---: |",
        "| SM4-CTR 1 MiB | 17.0 ms | 61.7 MB/s | gmssl 3.40 s | 200× |",
        "|  |  |  | OpenSSL 8.50 ms | 0.5× |",
        "| SM2 sign | 200 µs | — | — | — |",
        "| test[None] | 5.00 ns | — | — | — |",
    ]


def test_a_machine_without_a_brand_is_named_by_its_kind(report: dict[str, Any]) -> None:
    report["machine_info"] |= {"cpu": {}, "engines": None}
    del report["machine_info"]["engines"]
    assert "on x86_64, " in bench.markdown(report) and "engines unknown" in bench.markdown(report)


@pytest.mark.parametrize("seconds, text", [
    (1.0, "1.00 s"), (0.9999, "1000 ms"), (0.1, "100 ms"), (0.01234, "12.3 ms"), (1e-6, "1.00 µs"),
    (1e-9, "1.00 ns"), (1e-10, "0.100 ns"), (1234.5, "1234 s"),
])  # fmt: skip
def test_durations_have_three_digits_and_a_unit(seconds: float, text: str) -> None:
    assert bench.duration(seconds) == text


def test_the_table_goes_to_stdout_or_a_file(
    results: Path, report: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench.main([str(results)]) == 0
    assert capsys.readouterr().out == bench.markdown(report)
    assert bench.main([str(results), "--markdown", str(tmp_path / "table.md")]) == 0
    assert (tmp_path / "table.md").read_text("utf-8") == bench.markdown(report) and capsys.readouterr().out == ""


def test_the_picture_shows_every_ratio(results: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    import matplotlib

    path = tmp_path / "ratios.svg"
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        assert bench.main([str(results), "--picture", str(path)]) == 0
    drawn = path.read_text("utf-8")
    for text in ("SM4-CTR 1 MiB  vs gmssl", "SM4-CTR 1 MiB  vs OpenSSL", "200×", "0.5×"):
        assert text in drawn
    assert "elsewhere" not in drawn


def test_without_matplotlib_the_error_names_it(
    results: Path, report: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    for name in ("matplotlib", "matplotlib.figure"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependency, match="matplotlib"):
        bench.picture(report, tmp_path / "ratios.svg")
    assert bench.main([str(results), "--picture", str(tmp_path / "ratios.svg")]) == 1
    assert "matplotlib" in capsys.readouterr().err and not (tmp_path / "ratios.svg").exists()


@pytest.mark.parametrize("text", [None, "", "[]", "{}", "null", '{"benchmarks": [], "datetime": 5}'])
def test_a_file_that_is_no_report_is_said_to_be_none(
    tmp_path: Path, text: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "results.json"
    if text is not None:
        path.write_text(text)
    assert bench.main([str(path)]) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and "results.json" in captured.err and "pytest benchmarks/" in captured.err


def test_a_table_that_cannot_be_written_is_one_line(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench.main([str(results), "--markdown", str(tmp_path / "absent" / "table.md")]) == 1
    assert "absent" in capsys.readouterr().err


def test_it_runs_as_a_program(results: Path, report: dict[str, Any], capsys: pytest.CaptureFixture[str],
                              monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["bench", str(results)])
    with pytest.raises(SystemExit) as exit:
        runpy.run_path(str(RENDER), run_name="__main__")
    assert exit.value.code == 0 and capsys.readouterr().out == bench.markdown(report)


def test_a_real_run_is_read(tmp_path: Path) -> None:
    """One benchmark of the suite, measured now, beside its peers."""
    pytest.importorskip("pytest_benchmark")
    path = tmp_path / "results.json"
    subprocess.run(
        [sys.executable, "-m", "pytest", str(ROOT / "benchmarks" / "bench_sm3.py"), "-q", "-k", "digest and 64",
         "--benchmark-max-time=0.01", "--benchmark-min-rounds=1", "--benchmark-warmup=off", "-p", "no:xdist",
         "-p", "no:cacheprovider", f"--benchmark-json={path}"],
        check=True, capture_output=True, cwd=ROOT,
        # Not as a worker of a parallel run: there the plugin measures nothing.
        env={name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
        | {"PYTHONPATH": str(Path(smcrypto.__file__).parents[1])},
    )  # fmt: skip
    found = bench.comparisons(bench.timings(json.loads(path.read_text())))
    assert found and all(comparison.ours.median > 0 for comparison in found)
    assert bench.markdown(json.loads(path.read_text())).count("\n| ") >= len(found)


def test_the_peers_are_pinned_where_a_figure_names_their_version() -> None:
    """The README's ratios are against gmssl 3.2.2."""
    project = pytest.importorskip("tomllib").loads((ROOT / "pyproject.toml").read_text())["project"]
    assert "gmssl==3.2.2" in project["optional-dependencies"]["dev"]
