"""Drive the robot of robot.xml along a figure eight, in real time; print what its sensors say as JSON lines.

Runs in an environment with mujoco 4.0.0. Each line is one message to publish:
    {"topic": "odom", "x": ..., "y": ..., "heading": ..., "speed": ..., "turn": ...}
    {"topic": "imu", "orientation": [w, x, y, z], "angular_velocity": [...], "linear_acceleration": [...]}
Odometry is dead reckoning from the wheels' angles, as on a real robot: it drifts with their slip.
"""

import argparse
import json
import math
import sys
import time
from pathlib import Path

import mujoco
import numpy

WHEEL_RADIUS = 0.1
TRACK = 0.4
SPEED = 0.5
RADIUS = 1.1


def wheel_speeds(seconds: float, lap: float) -> tuple[float, float]:
    """Commanded speeds of the left and right wheel, rad/s: a circle to the left, then one to the right."""
    ramp = min(1.0, seconds / 0.5)
    turn = SPEED / RADIUS * math.tanh(8 * math.sin(math.pi * seconds / lap))
    left, right = SPEED - turn * TRACK / 2, SPEED + turn * TRACK / 2
    return ramp * left / WHEEL_RADIUS, ramp * right / WHEEL_RADIUS


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=10.0, help="of odometry and of IMU, Hz")
    parser.add_argument("--seed", type=int, default=1, help="of the sensors' noise")
    options = parser.parse_args()

    model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("robot.xml")))
    data = mujoco.MjData(model)
    noise = numpy.random.default_rng(options.seed)
    steps = round(1 / options.rate / model.opt.timestep)
    lap = options.seconds / 2
    x = y = heading = 0.0
    before = (0.0, 0.0)
    started = time.monotonic()
    for tick in range(round(options.seconds * options.rate)):
        for _ in range(steps):
            data.ctrl[:] = wheel_speeds(data.time, lap)
            mujoco.mj_step(model, data)
        angles = (data.sensor("left_angle").data[0], data.sensor("right_angle").data[0])
        left, right = ((now - then) * WHEEL_RADIUS for now, then in zip(angles, before, strict=True))
        before = angles
        travelled, turned = (left + right) / 2, (right - left) / TRACK
        x += travelled * math.cos(heading + turned / 2)
        y += travelled * math.sin(heading + turned / 2)
        heading += turned
        odometry = {
            "topic": "odom", "x": x, "y": y, "heading": math.remainder(heading, math.tau),
            "speed": travelled * options.rate, "turn": turned * options.rate,
        }  # fmt: skip
        imu = {
            "topic": "imu",
            "orientation": data.sensor("attitude").data.tolist(),
            "angular_velocity": (data.sensor("gyro").data + noise.normal(0, 0.002, 3)).tolist(),
            "linear_acceleration": (data.sensor("accelerometer").data + noise.normal(0, 0.02, 3)).tolist(),
        }
        time.sleep(max(0.0, started + (tick + 1) / options.rate - time.monotonic()))
        print(json.dumps(odometry), json.dumps(imu), sep="\n", flush=True)
    truth = data.body("base_link").xpos
    print(f"odometry ends at ({x:.3f}, {y:.3f}), the robot at ({truth[0]:.3f}, {truth[1]:.3f})", file=sys.stderr)


if __name__ == "__main__":
    main()
