"""Serve packers over HTTP: open bins, place boxes, fetch plans.

``marl-pack serve --data bins.sqlite`` listens on 127.0.0.1:8000. Every placement is in the file
before it is answered, so nothing that was answered is lost when the program or the machine stops.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from marl_pack.checks import shown, whole_number
from marl_pack.extras import missing
from marl_pack.files import check_writable
from marl_pack.terminal import Parser, announce_compiling, make_console

if TYPE_CHECKING:
    import socket

PROGRAM = "python -m marl_pack.serve"
LOOPBACK = "127.0.0.1"
BACKLOG = 2048
KEEP_ALIVE_S = 75
"""Seconds without a request after which a connection is closed; boxes come seconds apart."""
NOTE = """\
The API is described at /docs, and in docs/service.md. Anyone who reaches the address may use the
service: without --token-file it serves this machine only."""


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    from marl_pack.option_record import add_arguments
    from marl_pack.service.limits import ServiceLimits

    options = Parser(
        prog=program, usage=f"{program} --data FILE [OPTIONS]",
        description=__doc__.split("\n\n")[0], notes=[NOTE],
        examples=(
            "--data bins.sqlite",
            "--data bins.sqlite --host 0.0.0.0 --token-file token.txt --policy weights.json",
        ),
    )  # fmt: skip
    add = options.add_argument
    add("--data", type=Path, required=True, metavar="FILE",
        help="SQLite file of the bins; it is made if it does not exist")  # fmt: skip
    add("--host", default=LOOPBACK, help=f"address to listen on (default: {LOOPBACK})")
    add("--port", type=int, default=8000, help="port; 0 for any free one (default: 8000)")
    add("--token-file", type=Path, metavar="FILE",
        help="a file with one line, the token that clients have to send; needed unless the host is "
             "a loopback address")  # fmt: skip
    add("--policy", action="append", default=[], metavar="NAME",
        help="a policy that clients may choose besides the built-in ones: a .json file of "
             "marl-pack tune, a run's folder, a checkpoint or FILE.py:NAME; may be given several "
             "times")  # fmt: skip
    add("--access-log", action="store_true", help="print a line for each request")
    add_arguments(options.add_argument_group("limits"), ServiceLimits)
    return options


def read_token(path: Path) -> str:
    """Return the token in a file of one line.

    Raises:
        ValueError, OSError: unless it has one line of enough printable characters.
    """
    from marl_pack.inputs import read_text
    from marl_pack.service.guard import SHORTEST_TOKEN

    if not path.is_file():
        raise FileNotFoundError(f"--token-file {path}: no such file")
    token = read_text(path).strip()
    if len(token) < SHORTEST_TOKEN or not (token.isascii() and token.isprintable()):
        raise ValueError(
            f"--token-file {path}: needs one line of at least {SHORTEST_TOKEN} printable ASCII "
            "characters"
        )
    return token


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens.

    Raises:
        OSError: if that is impossible; says why.
    """
    import socket

    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listening = socket.socket(family, kind, protocol)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(BACKLOG)
    except OSError as error:
        raise OSError(f"cannot listen on {shown(host)}, port {port}: {error.strerror}") from None
    return listening


def run(chosen: argparse.Namespace) -> None:
    """Serve until the program is stopped.

    Raises:
        ValueError, OSError: if an option or a file is wrong; says what would be right.
        ModuleNotFoundError: without FastAPI and uvicorn.
    """
    from marl_pack.option_record import given_options
    from marl_pack.service.limits import ServiceLimits

    whole_number(chosen.port, "--port", 0, 65535)
    limits = ServiceLimits(**given_options(chosen, ServiceLimits))
    token = None if chosen.token_file is None else read_token(chosen.token_file)
    check_writable(chosen.data)
    try:
        import uvicorn

        from marl_pack.service.app import make_app
        from marl_pack.service.guard import is_loopback
    except ModuleNotFoundError as error:
        raise missing(error, "serve needs FastAPI and uvicorn", "serve") from None
    if token is None and not is_loopback(chosen.host):
        raise ValueError(
            f"--host {chosen.host}: others could reach it; needs --token-file, or a loopback "
            f"address such as {LOOPBACK}"
        )
    announce_compiling(make_console(stderr=True))
    from marl_pack.packer.warming import warm_up  # slow to import
    from marl_pack.service.service import Service
    from marl_pack.service.store import Store

    store = Store(chosen.data)
    service = Service(store, limits, chosen.policy)
    listening = listen(chosen.host, chosen.port)
    for policy in ("max_contact", "linear", "search"):
        warm_up({"policy": policy})
    host = f"[{chosen.host}]" if ":" in chosen.host else chosen.host
    address = f"http://{host}:{listening.getsockname()[1]}"

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            print(f"ready: {address}", flush=True)

    config = uvicorn.Config(
        make_app(service, token), log_level="info" if chosen.access_log else "warning",
        access_log=chosen.access_log, server_header=False, proxy_headers=False, lifespan="on",
        timeout_keep_alive=KEEP_ALIVE_S,
    )  # fmt: skip
    Server(config).run(sockets=[listening])


def _stop(*_: object) -> None:
    """End the program after SIGTERM, once the requests are finished."""
    sys.exit(0)


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack serve``; return its exit status."""
    options = parser(program)
    chosen = options.parse_args(arguments)
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may start it with it ignored
    try:
        run(chosen)
    except KeyboardInterrupt:
        options.exit(130, f"{options.prog}: interrupted")
    except (ValueError, OSError, ModuleNotFoundError) as error:
        options.exit(2, f"{options.prog}: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
