"""The paper's evaluation runs from its command to its page; how long anything takes is no matter here."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import geth_network
import load
import paper_page
import scale
from conftest import unavailable
from spread import across, along, at

ROOT = Path(scale.__file__).parents[1]
pytestmark = [pytest.mark.service, pytest.mark.slow]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        geth_network.find_geth()
    except geth_network.Unavailable as reason:
        unavailable(str(reason))
    folder = tmp_path_factory.mktemp("evaluation")
    command = [sys.executable, "-m", "benchmarks.paper", "--quick", "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "| server (--quick) | anvil |" in done.stdout
    return folder


def test_nothing_is_lost_doubled_or_refused(written: Path) -> None:
    found = {name: part["measured"] for name, part in json.loads((written / "evaluation.json").read_text()).items()}
    [user], [server], [bridge], [poa], [model] = (
        found[name] for name in ("user", "server", "bridge-poa", "poa", "scale")
    )
    assert user["delivered"] == user["messages"]
    for run in (*server["runs"], server["paced"], bridge["run"]):
        assert (run["lost"], run["doubled"], run["altered"], run["unsound"]) == (0, 0, 0, [])
        assert run["equal"] == run["sent"] == run["sessions"] * run["messages"]
    assert server["paced"]["sending"] > 1.0  # 20 messages at 10 a second
    [asked] = poa["runs"]
    assert (asked["registered"], asked["written"], asked["answered"]) == (4, 16, 16)
    assert all(row["equal"] == row["messages"] for row in model["compared"])


def test_the_page_has_every_part_and_its_pictures_are_there(written: Path) -> None:
    page = (written / "evaluation.md").read_text()
    for heading in (
        "User end", "Blockchain end", "Chain interaction", "The bridge on both networks", "From capture",
        "Beside an ordinary", "Past this",
    ):  # fmt: skip
        assert f"## {heading}" in page
    assert "Measured with the second edition" not in page and "Not measured yet: pow, bridge-pow" in page
    pictures = [line.partition("](")[2].rstrip(")") for line in page.splitlines() if line.startswith("![")]
    assert len(pictures) == 4
    assert all((written / name).read_text().lstrip().startswith("<?xml") for name in pictures)


def test_page_and_pictures_show_the_spread_of_several_runs(written: Path, tmp_path: Path) -> None:
    figures = json.loads((written / "evaluation.json").read_text())
    for part in figures.values():
        slower = json.loads(json.dumps(part["measured"][0]), parse_float=lambda text: 1.5 * float(text))
        part["measured"] = [part["measured"][0], slower]
    page = paper_page.page(figures)
    for section in page.split("\n## ")[1:]:
        assert re.search(r"\d \(\d[\d.,]*–\d", section), section
    assert len(paper_page.draw(figures, tmp_path)) == 4


def test_a_point_is_the_median_with_the_lowest_and_the_highest_run() -> None:
    runs = [{"ms": [4.0, 7.0]}, {"ms": [2.0, 7.0]}, {"ms": [3.5, 7.0]}]
    assert [point.say(".1f") for point in along(runs, at("ms"))] == ["3.5 (2.0–4.0)", "7.0"]
    assert across(runs[:1], at("ms", 0)).say(".0f") == "4"


def test_the_page_marks_what_an_earlier_edition_measured_and_says_how_to_measure_it_again() -> None:
    old = {"quick": False, "edition": 2, "seconds": 60.0,
           "machine": {"processor": "a core", "python": "3.11", "fast": True, "load": 0.1}}  # fmt: skip
    run = {"equal": 1, "sent": 1, "chunks": 1, "to_chain": 5.0, "lost": 0, "doubled": 0, "altered": 0}
    part = old | {"measured": [{"on": "geth", "run": run, "ready": 1.0, "confirmations": 3}]}
    page = paper_page.page({"bridge-poa": part})
    assert "| bridge-poa | geth | 0.1 | 1 | 1.0 | 2 |" in page and "edition 2 of the bridge" in page
    assert "`python -m benchmarks.paper --only bridge-poa`" in " ".join(page.split())  # lines are wrapped


def test_what_limits_a_load_is_said() -> None:
    def load_of(pace: float = 0.0, **use: float) -> str:
        figures = load.Figures(3, 10, 1, "sqlite", "anvil", 1, pace, storing=load.Use(**use))
        return load.limit_of([figures], lambda one: one.storing)

    cores = os.cpu_count() or 1
    assert load_of(rest=cores).startswith("the machine's")
    assert load_of(rest=0.1).startswith("waiting") and load_of(pace=10.0, rest=0.1).startswith("the robots' pace")
    if cores > 1:
        assert load_of(shards=0.7, submitters=0.3).startswith("one core a shard")


def test_the_model_needs_more_of_everything_for_more_robots() -> None:
    costs = scale.Costs(0.01, 0.5, 4.0, 0.05, 1.0, 0.2, 0.03, 0.4, 50.0, 70.0, 700.0, 100.0)
    for rate in scale.RATES:
        needs = [scale.need(costs, robots, rate, 1.0) for robots in scale.ROBOTS]
        for one, ten in zip(needs, needs[2:], strict=False):
            assert ten.gas_a_second == pytest.approx(ten.robots / one.robots * one.gas_a_second)
            assert ten.cores > one.cores and ten.bytes_a_day > one.bytes_a_day and ten.shards >= one.shards
    most = scale.most(costs, 10, 1.0, gas_a_second=30e6)
    assert scale.need(costs, most, 10, 1.0).gas_a_second <= 30e6 < scale.need(costs, most + 1, 10, 1.0).gas_a_second
    borne = scale.most(costs, 10, 1.0, submitter_cores=1.0)
    assert (scale.need(costs, borne, 10, 1.0).shards, scale.need(costs, borne + 1, 10, 1.0).shards) == (1, 2)
