"""`python -m services.ros2_gateway`: publishes robot data to ROS 2, and forwards accepted requests.

Without `--accept` it only publishes.
"""

from __future__ import annotations

import os
import time
from typing import Final

from services.ros2_gateway.conversions import TIME_LAST_NS, Conversions, RosTypes
from services.ros2_gateway.gateway import INPUTS, Gateway
from services.ros2_gateway.inbound import Inbound, acceptable, inbound_topics
from services.ros2_gateway.loop import PERIOD_NS, GatewayLoop, Input
from services.ros2_gateway.rmw import domain
from services.ros2_gateway.ros_session import RosLink, RosSession
from shared import log, process
from shared.bus import session as bus
from shared.bus import topics
from shared.bus.credentials import require_operator
from shared.bus.messages import Estop, OperatorIntent
from shared.clock import now_ns, sleep_until
from shared.config.files import load
from shared.joints import MODULES

NICE: Final = 5
"""Niceness of the gateway, so that control processes run first."""
DOMAIN_VARIABLE: Final = "ROS_DOMAIN_ID"


def main() -> int:
    """Run the gateway until SIGTERM or SIGINT; return the exit code."""
    parser = process.service_parser(__doc__ or "", "python -m services.ros2_gateway --domain 7")
    parser.add_argument(
        "--domain",
        type=domain,
        default=os.environ.get(DOMAIN_VARIABLE) or "0",
        help=f"domain of the ROS 2 network (default: ${DOMAIN_VARIABLE}, else 0)",
    )
    parser.add_argument(
        "--accept",
        type=acceptable,
        default=(),
        help="ROS 2 requests to accept: intent, estop or intent,estop (default: none)",
    )
    parser.add_argument("--simulated", action="store_true", help="publish /clock")
    arguments = parser.parse_args()
    logger = log.setup("ros2_gateway")
    config = load(arguments.config)
    stop = process.StopFlag()
    os.nice(NICE)
    if arguments.accept:
        require_operator(config, "ros2_gateway")
    types = RosTypes(config.ros2.distribution)
    gateway = Gateway(config, Conversions(config, types), simulated=arguments.simulated)
    ros2 = config.ros2

    def joined() -> RosSession:
        ros = RosSession(ros2.router, arguments.domain, types, namespace=ros2.namespace)
        try:
            known = inbound_topics(ros2.namespace)
            ros.show_node()
            ros.publish(gateway.sent_topics)
            ros.subscribe([getattr(known, name) for name in arguments.accept])
            ros.put(*gateway.description())
        except BaseException:
            ros.close()
            raise
        logger.info("connected to the router")
        return ros

    with bus.open_session(config, "ros2_gateway", arguments.run_dir) as session:
        wanted = [(t, m) for t in INPUTS for m in (MODULES if t.per_module else ("",))]
        inputs: list[Input] = [(t, m, session.latest(t, t.type, m)) for t, m in wanted]
        link = RosLink(joined, lambda error: logger.warning("%s; retrying", error))
        loop = GatewayLoop(gateway, inputs, link)
        if arguments.accept:
            intents = session.publisher(topics.OPERATOR_INTENT, OperatorIntent)
            loop.accept(Inbound(config), intents, session.publisher(topics.ESTOP, Estop))
        logger.info(
            "started for %s, domain %d, router %s; accepts %s",
            ros2.distribution,
            arguments.domain,
            ros2.router,
            " and ".join(arguments.accept) or "nothing",
        )
        process.freeze_garbage()
        if time.time_ns() > TIME_LAST_NS:
            logger.warning(
                "this host's clock is past 2038-01-19, when ROS 2 timestamps end: correct it"
            )
        offset_ns = time.time_ns() - now_ns()
        deadline_ns = now_ns()
        while not stop:
            now = now_ns()
            # a simulated robot has its own time, maybe in slow motion; a real robot uses UTC
            loop.cycle(now, now + offset_ns if arguments.simulated else time.time_ns())
            deadline_ns = max(deadline_ns + PERIOD_NS, now)
            sleep_until(deadline_ns)
        link.close()
    logger.info("stopped: %d cycles, %s", loop.cycles, loop.figures())
    return 0


if __name__ == "__main__":
    process.run_service(main)
