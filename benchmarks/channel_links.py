"""Through the simulated network of the tests: time until a robot may send its first chunk, and the rate after that.

Run by bench_channel.py --link, for this commit and for another one beside it: imports nothing but what both have.
"""

from __future__ import annotations

import statistics
import sys

from bridge.channel.simulation import Faults, Network
from bridge.channel.world import RobotProgram, ServerProgram

CHUNK = 8_600  # bytes: 100 records of the sample's Odometry


def first_chunk(loss: float, round_trip: float, seed: int) -> float:
    """Seconds from nothing to the server's word of what it has."""
    network = Network(seed, Faults(loss=loss, delay=round_trip / 2))
    ServerProgram(network)
    robot = RobotProgram(network, [])
    heard, times = robot.host.on_event, list[float]()

    def note(event: object) -> None:
        heard(event)
        if robot.sent is not None:
            times.append(network.now - 1000.0)

    robot.host.on_event = note
    network.run(lambda: bool(times))
    return float(times[0])


def rate(loss: float, round_trip: float) -> float:
    """kB/s of stored chunks in the first 30 seconds."""
    network = Network(1, Faults(loss=loss, delay=round_trip / 2, jitter=round_trip / 20))
    hub = ServerProgram(network)
    robot = RobotProgram(network, [bytes(CHUNK)] * 100_000)
    network.run(lambda: robot.sent is not None)
    began, stored = network.now, hub.stored.setdefault("robot_1", [])
    network.run(lambda: network.now > began + 30.0 or len(stored) > 1500)
    return float(len(stored) * CHUNK / (network.now - began) / 1e3)


def main(seeds: int) -> None:
    print("  s until the first chunk may go     median   95 %")
    for round_trip, loss in ((0.04, 0.0), (0.04, 0.1), (0.04, 0.3), (0.6, 0.0), (0.6, 0.1), (0.6, 0.3)):
        times = [first_chunk(loss, round_trip, seed) for seed in range(seeds if loss else 2)]
        print(f"    {round_trip * 1000:3.0f} ms, {loss:4.0%} loss {statistics.median(times):22.2f}"
              f"{statistics.quantiles(times, n=20)[-1]:7.2f}", flush=True)
    print("  kB/s, jitter 5 %                  no loss   10 %   30 %")
    for round_trip in (0.05, 0.2, 0.6):
        row = "".join(f"{rate(loss, round_trip):7.0f}" for loss in (0.0, 0.1, 0.3))
        print(f"    round trip {round_trip * 1000:3.0f} ms                {row}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
