"""Send an intent over Zenoh: request 40 N of assist from a running fleet for five seconds.

Run `xrl up`. Once `xrl status` shows that the planner leads, run: python examples/send_intent.py
An intent that is not repeated fades out, so this script publishes it at 50 Hz.
"""

from __future__ import annotations

import time
from pathlib import Path

from shared.bus import topics
from shared.bus.messages import OperatorIntent, PlannerStatus
from shared.bus.session import open_session
from shared.clock import now_ns
from shared.run_directory import default_run_dir
from tools.fleet.supervise import SupervisedFleet

FOR_S, ASSIST_N = 5.0, 40.0


def main(run_dir: Path) -> None:
    """Publish the intent, and print the assist that the planner gives."""
    fleet = SupervisedFleet.attach(run_dir)
    robot = fleet.manifest.robot()
    with open_session(robot, "assist", run_dir) as session:
        intents = session.publisher(topics.OPERATOR_INTENT, OperatorIntent)
        statuses = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        end, given = time.monotonic() + FOR_S, 0.0
        for seq in range(round(FOR_S * 50)):
            intents.put(OperatorIntent(t_ns=now_ns(), seq=seq, assist_n=ASSIST_N, source="example"))
            status = statuses.take()
            if status is not None:
                given = status.assist_n
            time.sleep(max(0.0, min(0.02, end - time.monotonic())))
    print(f"the planner gives {given:.0f} of {ASSIST_N:.0f} N")


if __name__ == "__main__":
    main(default_run_dir())
