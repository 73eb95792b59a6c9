"""`pytest benchmarks/` prints pytest-benchmark's table and writes JSON for `python benchmarks/render.py`.

Each benchmark sets its group (the row of the table) and says in
extra_info["implementation"] whose code ran; extra_info["bytes"] gives the
size of the input where a rate makes sense. The engines are those that are installed, or with SMCRYPTO_PURE=1 Python's.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from smcrypto import sm3
from smcrypto.sm2 import points
from smcrypto.sm4 import foreign

RESULTS = Path(__file__).parent / "results.json"


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    if getattr(config.option, "benchmark_json", "absent") is None:
        config.option.benchmark_json = RESULTS
        # Each figure is of one engine: those that are chosen are imported at once.
        for engine in (points.ENGINE, foreign.ENGINE):
            engine.after(1 << 30)
        # A round is as many calls as take a millisecond: the plugin's own 5 microseconds would measure
        # the plugin beside calls that take four.
        config.option.benchmark_min_time = type(config.option.benchmark_min_time)("0.001")


def pytest_benchmark_update_machine_info(config: pytest.Config, machine_info: dict[str, object]) -> None:
    machine_info["engines"] = ", ".join(
        f"{name} by {engine}"
        for name, engine in (("SM2", points.ENGINE.name), ("SM3", sm3.ENGINE), ("SM4", foreign.ENGINE.name))
    )
