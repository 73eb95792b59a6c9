"""The paper's evaluation runs from its command to its page; how long anything takes is no matter here."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import geth_network
import scale
from conftest import unavailable

pytestmark = [pytest.mark.service, pytest.mark.slow]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        geth_network.find_geth()
    except geth_network.Unavailable as reason:
        unavailable(str(reason))
    folder = tmp_path_factory.mktemp("evaluation")
    command = [sys.executable, str(Path(scale.__file__).with_name("paper.py")), "--quick", "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr[-2000:]
    return folder


def test_nothing_is_lost_doubled_or_refused(written: Path) -> None:
    found = json.loads((written / "evaluation.json").read_text())
    assert found["user"]["delivered"] == found["user"]["messages"]
    runs = [*found["server"]["runs"], found["bridge-poa"]["run"]]
    assert all((run["lost"], run["doubled"], run["altered"], run["unsound"]) == (0, 0, 0, []) for run in runs)
    assert all(run["equal"] == run["sent"] == run["sessions"] * run["messages"] for run in runs)
    [asked] = found["poa"]["runs"]
    assert (asked["registered"], asked["written"], asked["answered"]) == (4, 16, 16)
    assert all(row["equal"] == row["messages"] for row in found["scale"]["compared"])


def test_the_page_has_every_part_and_its_pictures_are_there(written: Path) -> None:
    page = (written / "evaluation.md").read_text()
    for heading in (
        "User end", "Blockchain end", "Chain interaction", "The bridge on both networks", "From capture",
        "Beside an ordinary", "Past this",
    ):  # fmt: skip
        assert f"## {heading}" in page
    pictures = [line.partition("](")[2].rstrip(")") for line in page.splitlines() if line.startswith("![")]
    assert len(pictures) == 4
    assert all((written / name).read_text().lstrip().startswith("<?xml") for name in pictures)


def test_the_model_needs_more_of_everything_for_more_robots() -> None:
    costs = scale.Costs(0.01, 0.5, 4.0, 1.0, 0.2, 70.0, 700.0, 100.0)
    for rate in scale.RATES:
        needs = [scale.need(costs, robots, rate, 1.0) for robots in scale.ROBOTS]
        for one, ten in zip(needs, needs[2:], strict=False):
            assert ten.gas_a_second == pytest.approx(ten.robots / one.robots * one.gas_a_second)
            assert ten.cores > one.cores and ten.bytes_a_day > one.bytes_a_day and ten.shards >= one.shards
    most = scale.most(costs, 10, 1.0, gas_a_second=30e6)
    assert scale.need(costs, most, 10, 1.0).gas_a_second <= 30e6 < scale.need(costs, most + 1, 10, 1.0).gas_a_second
    borne = scale.most(costs, 10, 1.0, submitter_cores=1.0)
    assert (scale.need(costs, borne, 10, 1.0).shards, scale.need(costs, borne + 1, 10, 1.0).shards) == (1, 2)
