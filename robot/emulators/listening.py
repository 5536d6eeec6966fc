"""The addresses on which emulators listen: loopback, unless the network is asked for; fault requests; and
emulators as programs.

A fault request is an object {"do": name, ...} with the arguments of the fault.
"""

from __future__ import annotations

import argparse
import asyncio
import errno
import ipaddress
import json
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from contextlib import ExitStack, asynccontextmanager, suppress
from functools import partial
from typing import Any, TypeVar

from pydantic import ValidationError

from tactile.base.errors import InputError
from tactile.base.settings import Settings

Model = TypeVar("Model", bound=Settings)

OPENS = "anyone who reaches this address may command, fault or stop the emulator"
Client = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
"""Serves one client of a port."""


@asynccontextmanager
async def open_ports(
    host: str, open_to_network: bool, clients: Iterable[tuple[Client, int]]
) -> AsyncIterator[None]:
    """A context that serves ports.

    Raises:
        InputError: the address is not loopback and the network was not asked for, or it cannot be used.
    """
    if not (open_to_network or is_loopback(host)):
        cure = f"or `--open-to-network` (open_to_network: true): {OPENS}"
        found, expected = "an address that others may reach", "loopback, such as 127.0.0.11"
        raise InputError(repr(host), found, expected, cure)
    with ExitStack() as stack:
        for client, port in clients:
            where, cure = f"{host}:{port}", "choose an address of this machine with --host"
            try:
                opened = await asyncio.start_server(partial(_talk, client), host, port)
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    found = "something listens there already, such as another emulator"
                    raise InputError(where, found, "a free address", f"use it, stop it, or {cure}") from None
                found = f"cannot listen ({error.strerror})"
                raise InputError(where, found, "a free address", cure) from None
            stack.callback(opened.close)  # without waiting for clients that stay connected
        yield


async def _talk(client: Client, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Serves a client; a disconnection is no error."""
    with suppress(OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
        await client(reader, writer)
    writer.close()


def is_loopback(host: str) -> bool:
    """Whether an address is reached from this machine only."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def run_emulator(arguments: argparse.Namespace, model: type[Model], serve: Callable[[Model], None]) -> int:
    """Serves an emulator until the process is ended; returns the exit code.

    Args:
        arguments: `config`, settings as JSON, and settings by name, which override them; None: not given.
    """
    given = {key: value for key, value in vars(arguments).items() if value is not None}
    try:
        written = model.model_validate_json(given.pop("config", "{}"))
        serve(model.model_validate(written.model_dump() | given))
    except (InputError, ValidationError) as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        pass
    return 0


def do_fault(known: Mapping[str, Callable[..., Any]], request: Mapping[str, Any]) -> dict[str, Any]:
    """Executes a fault request; returns what its function does, {"ok": True} if nothing.

    Raises:
        ValueError, TypeError: unknown fault or invalid arguments.
    """
    arguments = dict(request)
    name = str(arguments.pop("do", ""))
    if name not in known:
        raise ValueError(f"{name!r}; known are {', '.join(known)}")
    return known[name](**arguments) or {"ok": True}


def answer_fault(line: str | bytes, do: Callable[[dict[str, Any]], dict[str, Any]]) -> bytes:
    """The answer to a line of JSON with a fault request, or the error in it, as such a line."""
    try:
        answer = do(dict(json.loads(line)))
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        answer = {"ok": False, "error": f"{type(error).__name__}: {error}"}
    return json.dumps(answer).encode() + b"\n"
