"""`demo`: the main job on this machine, with nothing but Python, in less than half a minute."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from rosbridge_eth.cli.output import Json, data, errors, print_json, table, talk
from rosbridge_eth.errors import VerificationError
from rosbridge_eth.operations.logs import log_to_stderr


def add_commands(app: typer.Typer) -> None:
    app.command(epilog="Example: rosbridge-eth demo --report demo-report")(demo)


def demo(
    report: Annotated[Path, typer.Option(help="Folder for the report; made if absent.")] = Path("demo-report"),
    bag: Annotated[Path | None, typer.Option(help="A bag of your own; without it, the sample.")] = None,
    topic: Annotated[list[str] | None, typer.Option(help="Topics to take; without it, /robot_1/odom.")] = None,
    loss: Annotated[
        float, typer.Option(min=0, max=0.9, help="Lose this share of the datagrams, and reorder and double some.")
    ] = 0.0,
    json: Json = False,
) -> None:
    """Replay a real bag over real UDP onto an Ethereum chain in this process, read it back, prove and compare it.

    Exits with 9 if a single record is missing, altered or doubled.
    """
    from rosbridge_eth.demo import ROBOT, Stages, run_demo
    from rosbridge_eth.reading import outputs
    from rosbridge_eth.relay import Harm
    from rosbridge_eth.sources.sample import sample_bag

    log_to_stderr()
    report.mkdir(parents=True, exist_ok=True)  # what cannot be written is told now, not after all the work
    chosen = bag or sample_bag()
    topics = topic or [f"/{ROBOT}/odom"]
    columns = (TextColumn("{task.description:<34}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=errors) as progress, tempfile.TemporaryDirectory(prefix="rosbridge-eth-") as home:
        total = _expected(chosen, topics)
        bars = {name: progress.add_task(name, total=total) for name in ("captured", "stored", "included", "verified")}

        def show(stages: Stages) -> None:
            for name, bar in bars.items():
                progress.update(bar, completed=getattr(stages, name))

        result = run_demo(
            Path(home), chosen, topics=topics, harm=Harm(loss, loss / 4, loss / 2),
            on_stage=lambda text: progress.console.print(f"· {text}"), on_progress=show,
        )
    stages = result.stages
    proven = [record.proven for record in result.records]
    (report / "records.jsonl").write_text("".join(outputs.json_line(record) for record in proven), encoding="utf-8")
    outputs.draw_trajectory(report / "trajectory.png", proven)

    labels = {
        "captured": "captured", "sent": "sent, with the stream's open and end", "retransmitted": "frames retransmitted",
        "stored": "stored by the server", "included": "included in a block", "verified": "verified against the bag",
    }
    counts = [(label, getattr(stages, name)) for name, label in labels.items()]
    times = [(name, f"{seconds * 1000:.2f} ms") for name, seconds in stages.times.items()]
    batches = [
        (number, batch.records, batch.block_number, batch.gas_used, f"{batch.gas_used / batch.records:.0f}",
         "0x" + batch.tx_hash.hex())
        for number, batch in enumerate(result.batches, 1)
    ]
    heads = ("batch", "records", "block", "gas", "gas/record", "transaction")
    findings = [str(found) for found in (*result.reading.history.problems, *result.reading.proven.findings)]
    (report / "report.html").write_text(
        _html(chosen, result.contract, counts, times, heads, batches, findings, result.passed), encoding="utf-8"
    )
    if json:
        print_json({
            "passed": result.passed, "seconds": result.seconds, "times": stages.times,
            "counts": {name: getattr(stages, name) for name in labels},
            "contract": result.contract, "findings": findings, "differences": list(result.comparison.differences),
            "batches": [dict(zip(("number", "records", "block", "gas", "gas_per_record", "transaction"), row,
                                 strict=True)) for row in batches],
        })
    else:
        data.print(table("Records", ["stage", "records"], counts, right=[1]))
        data.print(table("Time", ["step", "time"], times, right=[1]))
        data.print(table(f"Transactions to {result.contract}", heads, batches, right=[0, 1, 2, 3, 4]))
    for line in (*findings, *result.comparison.differences):
        talk(line)
    if not result.passed:
        raise VerificationError("not every record came back as it is in the bag; the lines above say which")
    talk(f"{stages.verified} of {stages.captured} records came back from the chain, proven and equal to the bag's, "
         f"in {result.seconds:.1f} s. The report is {report / 'report.html'}.")


def _expected(bag: Path, topics: list[str]) -> int:
    from rosbridge_eth.sources import BagSettings, Selection
    from rosbridge_eth.sources.bag import BagSource

    source = BagSource(BagSettings(bag), Selection(topics))
    try:
        return source.message_count
    finally:
        source.close()


def _html(
    bag: Path, contract: str, counts: list[tuple[str, int]], times: list[tuple[str, str]], heads: tuple[str, ...],
    batches: list[tuple[int, int, int, int, str, str]], findings: list[str], passed: bool,
) -> str:
    """A page that needs nothing but its folder."""

    def rows(lines: Iterable[Sequence[object]]) -> str:
        return "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in line) + "</tr>"
                       for line in lines)

    verdict = "Every record came back, proven and equal to the bag's." if passed else "Not every record came back."
    return f"""<!doctype html><html lang="en"><meta charset="utf-8"><title>From a topic to the chain and back</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222 }}
table {{ border-collapse: collapse; margin: .5rem 0 1.5rem }} td, th {{ border: 1px solid #ccc; padding: .2rem .7rem }}
td {{ font-variant-numeric: tabular-nums }} .verdict {{ font-weight: 600; color: {"#1a6b3c" if passed else "#a32020"} }}
img {{ max-width: 100% }} code {{ overflow-wrap: anywhere }}
</style>
<h1>From a topic to the chain and back</h1>
<p class="verdict">{verdict}</p>
<p>Bag <code>{escape(bag.name)}</code>, contract <code>{escape(contract)}</code>.
The records as JSON lines: <a href="records.jsonl">records.jsonl</a>.</p>
<h2>The trajectory, from the chain</h2><img src="trajectory.png" alt="Trajectory drawn from the records on the chain">
<h2>Records by stage</h2><table><tr><th>stage</th><th>records</th></tr>{rows(counts)}</table>
<h2>Time</h2><table><tr><th>step</th><th>time</th></tr>{rows(times)}</table>
<h2>Transactions</h2><table><tr>{"".join(f"<th>{head}</th>" for head in heads)}</tr>{rows(batches)}</table>
<h2>Findings</h2><ul>{"".join(f"<li>{escape(found)}</li>" for found in findings or ["None."])}</ul>
</html>
"""
