"""Read a run into NumPy arrays: the range of the COM, and the age of a knee's commands.

Run: xrl sim --out out/first && python examples/read_a_run.py out/first/run.mcap
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from shared.bus import topics
from tools.logs.run_log import read_run


def main(path: Path) -> None:
    """Print a summary of a log, which may be unfinished or split."""
    log = read_run(path)
    truth = [row for row in log.messages(topics.SIM_TRUTH) if row.scenario_s >= 0.0]
    t = np.array([row.scenario_s for row in truth])  # (n,), s
    com = np.array([row.over for row in truth])  # (n, 2), m, from the midpoint of the ankles
    states = log.messages(topics.JOINT_STATE, "knee_left")
    age = np.array([row.age_ns for row in states if row.age_ns >= 0]) / 1e6  # ms
    print(f"{t[-1]:.1f} s, COM x {1e3 * com[:, 0].min():.1f} .. {1e3 * com[:, 0].max():.1f} mm")
    print(f"knee_left: {len(states)} states, age {np.median(age):.1f} ms in the median")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("run", type=Path, metavar="RUN.mcap")
    main(parser.parse_args().run)
