"""Planner process (`python -m services.planner`), which runs the whole-body law."""

from __future__ import annotations

import secrets

from services.planner.controller import controller_maker
from services.planner.loop import PlannerLoop, PlannerPorts, requests_of
from services.planner.planner import Planner
from shared import log, planner_life, scheduling
from shared.bus import topics
from shared.bus.messages import (
    Attitude,
    JointCommand,
    JointState,
    OperatorIntent,
    PlannerStatus,
    Wrench,
)
from shared.bus.session import open_session
from shared.bus.traces import PlannerCheckpoint
from shared.config import files as config_file
from shared.config import gain_schedule
from shared.joints import MODULES
from shared.planner_life import OwnLife
from shared.process import (
    StopFlag,
    add_injected,
    freeze_garbage,
    run_service,
    service_parser,
)


def main() -> int:
    """Connect the planner to the bus and run it."""
    parser = service_parser(
        "Run the whole-body law.", "python -m services.planner --run-dir /tmp/xrl"
    )
    add_injected(parser)
    parser.add_argument(
        "--controller",
        metavar="FILE.py[:NAME]",
        help="your own controller, instead of the law (docs/own-controller.md)",
    )
    arguments = parser.parse_args()
    logger = log.setup("planner")
    robot = config_file.load(arguments.config)
    gain_schedule.require(robot, arguments.config)
    controller = None
    if arguments.controller is not None:
        controller = controller_maker(arguments.controller, robot)()
    stop = StopFlag()
    granted = scheduling.apply("planner")
    life = planner_life.if_possible(OwnLife, arguments.run_dir)
    with open_session(robot, "planner", arguments.run_dir, injected=arguments.injected) as session:
        ports = PlannerPorts(
            states=[session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES],
            wrench=session.latest(topics.WRENCH, Wrench),
            attitude=session.latest(topics.ATTITUDE, Attitude),
            request=requests_of(robot, session.latest(topics.OPERATOR_INTENT, OperatorIntent)),
            commands=[session.publisher(topics.JOINT_COMMAND, JointCommand, m) for m in MODULES],
            status=session.publisher(topics.PLANNER_STATUS, PlannerStatus),
            checkpoint=session.publisher(topics.PLANNER_CHECKPOINT, PlannerCheckpoint),
            announce=None if life is None else life.announce,
        )
        session_id = secrets.randbelow(1 << 53) + 1  # JSON readers keep 53 bits
        loop = PlannerLoop(robot, Planner(robot, session_id, controller), ports)
        own = f", controller {arguments.controller}" if controller is not None else ""
        logger.info("up, %s, session %d%s", granted, session_id, own)
        freeze_garbage()
        loop.run(stop)
    logger.info("stopped")
    return 0


if __name__ == "__main__":
    run_service(main)
