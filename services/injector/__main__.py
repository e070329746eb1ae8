"""`python -m services.injector`: a bad network on purpose, between planner, joints and harness.

They dial it (`--injected`) in place of one another; `xrl inject` says what it is to do.
"""

from __future__ import annotations

import socket
from pathlib import Path

from services.injector.control import Control
from services.injector.loop import Orders, run
from services.injector.relay import Place, Relay
from shared import bus, log, process, topics
from shared.config import RobotConfig, expand
from shared.config_file import load
from shared.exceptions import BusError
from shared.impairment import Direction
from shared.injection import SOCKET
from shared.injections import Injections
from shared.links import DIRECTIONS, PAIRS, Pair, endpoint_through
from shared.priority import raise_priority
from shared.traces import LinkEvent

FIFO_PRIORITY = 15
"""With those whose messages it passes on: what it delays by itself is not asked for."""
_UNIX = "unixsock-stream/"


def main() -> int:
    """Run until SIGTERM or SIGINT; return the exit code."""
    parser = process.service_parser(__doc__ or "", "python -m services.injector")
    parser.add_argument("--seed", type=int, default=0, help="of what is lost, and how late (0)")
    arguments = parser.parse_args()
    logger = log.setup("injector")
    config = load(arguments.config)
    stop = process.StopFlag()
    granted = raise_priority(FIFO_PRIORITY)
    directions = {name: Direction(name, arguments.seed) for name in DIRECTIONS}
    with bus.open_session(config, "injector", arguments.run_dir) as session:
        events = session.publisher(topics.LINK_EVENT, LinkEvent)
        injections = Injections(directions, events.put)
        orders = Orders(injections)
        places = [_place(pair, config, arguments.run_dir) for pair in PAIRS]
        relay = Relay(places, directions)
        control = Control(arguments.run_dir / SOCKET, orders.obey)
        logger.info("between %d pairs, priority %s", len(places), granted)
        process.freeze_garbage()
        try:
            run(relay, control, orders, injections, stop)
        finally:
            control.close()
            relay.close()
            for pair in PAIRS:
                _socket_path(pair, arguments.run_dir).unlink(missing_ok=True)
    logger.info("stopped: %d connections to a process that was not there", relay.refused)
    return 0


def _place(pair: Pair, config: RobotConfig, run_dir: Path) -> Place:
    """Listen for the one that dials.

    Raises:
        BusError: it is not possible there.
    """
    path = _socket_path(pair, run_dir)
    path.unlink(missing_ok=True)  # of an injector that was killed
    listener = socket.socket(socket.AF_UNIX)
    try:
        listener.bind(str(path))
        listener.listen()
    except OSError as error:
        raise BusError(f"{path}: {error.strerror}; an endpoint it may use is needed") from None
    listener.setblocking(False)
    return Place(pair, listener, address_of(expand(config.bus.endpoints[pair.listens], run_dir)))


def address_of(endpoint: str) -> str | tuple[str, int]:
    """Return a Zenoh endpoint as a socket's address.

    Raises:
        BusError: it is neither a UNIX socket nor TCP.
    """
    kind, _, place = endpoint.partition("/")
    if kind == "unixsock-stream":
        return place
    host, _, port = place.partition("?")[0].partition("#")[0].rpartition(":")
    if kind != "tcp" or not port.isdecimal():
        raise BusError(f"{endpoint}: cannot be stood before; unixsock-stream or tcp can")
    return host.strip("[]"), int(port)


def _socket_path(pair: Pair, run_dir: Path) -> Path:
    return Path(expand(endpoint_through(pair), run_dir).removeprefix(_UNIX))


if __name__ == "__main__":
    process.run_service(main)
