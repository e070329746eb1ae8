"""`python -m services.network_proxy`: impairs the network between the services on purpose.

Services dial the proxy instead of each other (`--injected`); `xrl inject` controls it.
"""

from __future__ import annotations

from pathlib import Path

from services.network_proxy.control import CommandHandler, ControlSocket
from services.network_proxy.loop import run
from services.network_proxy.relay import Relay
from services.network_proxy.sockets import ProxyEndpoint, SocketListener, SocketWatch, address_of
from shared import log, process, scheduling
from shared.bus import session as bus
from shared.bus import topics
from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_MS, now_ns
from shared.config.files import load
from shared.config.impairment import Direction
from shared.config.robot_config import RobotConfig, expand
from shared.links import DIRECTIONS, PAIRS, Pair, endpoint_through
from shared.network.impairment_schedule import ImpairmentSchedule
from shared.network.proxy_protocol import SOCKET
from shared.run_directory import live_dir

_UNIX = "unixsock-stream/"


def main() -> int:
    """Run until SIGTERM or SIGINT; return the exit code."""
    parser = process.service_parser(__doc__ or "", "python -m services.network_proxy")
    parser.add_argument("--seed", type=int, default=0, help="seed of losses and delays (0)")
    arguments = parser.parse_args()
    logger = log.setup("network_proxy")
    config = load(arguments.config)
    stop = process.StopFlag()
    granted = scheduling.apply("network_proxy")
    directions = {name: Direction(name, arguments.seed) for name in DIRECTIONS}
    endpoints = [_proxy_endpoint(pair, config, arguments.run_dir) for pair in PAIRS]
    watch = SocketWatch()
    relay = Relay(endpoints, directions, watch, round(config.bus.lease_ms * NS_PER_MS))
    with bus.open_session(config, "network_proxy", arguments.run_dir) as session:
        impairments = ImpairmentSchedule(
            directions, session.publisher(topics.LINK_EVENT, LinkEvent).put
        )
        commands = CommandHandler(impairments)
        control = ControlSocket(live_dir(arguments.run_dir) / SOCKET, commands.obey, watch)
        logger.info("relaying between %d pairs of processes, priority %s", len(endpoints), granted)
        process.freeze_garbage()
        try:
            run(watch, relay, commands, impairments, stop)
        finally:
            control.close()
            relay.close()
            impairments.clear("all", now_ns())  # so that the log has every impairment's counts
            watch.close()
    logger.info(
        "stopped: connections refused: %d, stuck connections closed: %d",
        relay.refused,
        relay.stuck,
    )
    return 0


def _proxy_endpoint(pair: Pair, config: RobotConfig, run_dir: Path) -> ProxyEndpoint:
    path = Path(expand(endpoint_through(pair), run_dir).removeprefix(_UNIX))
    beyond = address_of(expand(config.bus.endpoints[pair.listens], run_dir))
    return ProxyEndpoint(pair, SocketListener(path), beyond)


if __name__ == "__main__":
    process.run_service(main)
