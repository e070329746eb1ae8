"""Runs the planner process (`python -m services.planner`): the fleet's whole-body law."""

from __future__ import annotations

import secrets

from services.planner.loop import PlannerLoop, PlannerPorts
from services.planner.planner import Planner
from shared import config_file, gain_schedule, log, topics
from shared.bus import open_session
from shared.joints import MODULES
from shared.messages import (
    Attitude,
    JointCommand,
    JointState,
    OperatorIntent,
    PlannerStatus,
    Wrench,
)
from shared.priority import raise_priority
from shared.process import (
    StopFlag,
    add_injected,
    freeze_garbage,
    run_service,
    service_parser,
)
from shared.traces import PlannerCheckpoint

FIFO_PRIORITY = 15
"""Below the joint services, because the failsafe has priority over the law."""


def main() -> int:
    """Connect the planner to the bus and run it."""
    parser = service_parser(
        "Run the whole-body law.", "python -m services.planner --run-dir /tmp/xrl"
    )
    add_injected(parser)
    arguments = parser.parse_args()
    logger = log.setup("planner")
    robot = config_file.load(arguments.config)
    gain_schedule.require(robot, arguments.config)
    stop = StopFlag()
    granted = raise_priority(FIFO_PRIORITY)
    with open_session(robot, "planner", arguments.run_dir, injected=arguments.injected) as session:
        ports = PlannerPorts(
            states=[session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES],
            wrench=session.latest(topics.WRENCH, Wrench),
            attitude=session.latest(topics.ATTITUDE, Attitude),
            intent=session.latest(topics.OPERATOR_INTENT, OperatorIntent),
            commands=[session.publisher(topics.JOINT_COMMAND, JointCommand, m) for m in MODULES],
            status=session.publisher(topics.PLANNER_STATUS, PlannerStatus),
            checkpoint=session.publisher(topics.PLANNER_CHECKPOINT, PlannerCheckpoint),
        )
        session_id = secrets.randbelow(1 << 53) + 1  # JSON readers keep 53 bits
        loop = PlannerLoop(robot, Planner(robot, session_id), ports)
        logger.info("up, %s, session %d", granted, session_id)
        freeze_garbage()
        loop.run(stop)
    logger.info("stopped")
    return 0


if __name__ == "__main__":
    run_service(main)
