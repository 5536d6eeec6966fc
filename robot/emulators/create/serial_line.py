"""The emulated serial line: a pseudo-terminal, and its faults."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from robot.drivers.create.protocol import BAUD
from tactile.base.atomic_write import temporary_path
from tactile.base.errors import InputError, os_errors_of
from tactile.base.random_streams import stream


class LineFaults:
    """Faults of the serial line."""

    def __init__(self, seed: int) -> None:
        self._random = stream(seed, "create garbage")
        self.garbage, self.lose, self.scramble, self.trickle = 0, 0, 0, 0.0
        self.cut: int | None = None

    def disturb(self, reply: bytes) -> bytes:
        """The reply after the pending faults."""
        if self.lose:
            self.lose -= 1
            return b""
        if self.scramble:
            self.scramble -= 1
            return self.noise(reply)
        if self.cut is not None:
            reply, self.cut = reply[: self.cut], None
        before, self.garbage = self._random.bytes(self.garbage), 0
        return before + reply

    def noise(self, reply: bytes) -> bytes:
        """The reply as received at another baud rate."""
        return self._random.bytes(len(reply))


class Terminal:
    """A pseudo-terminal that looks like a serial port to the program at its other end.

    Args:
        link: name of a link to it, which stays the same when it is plugged in again; None for no link.

    Attributes:
        master: descriptor of this end. path: name of the other end. plugged: whether it exists.

    Raises:
        InputError: the system has no pseudo-terminals, or the link's name is taken.
    """

    def __init__(self, link: str | None = None) -> None:
        try:
            import termios
            import tty
        except ImportError:
            raise InputError(sys.platform, "has no pseudo-terminals", "Linux or macOS") from None
        self._termios, self._tty = termios, tty
        self._link = None if link is None else Path(link)
        self.plugged = False
        self.plug()

    def plug(self) -> None:
        """Makes the terminal, or a new one after `unplug`."""
        if self.plugged:
            return
        self.master, self._slave = os.openpty()  # the slave stays open: without one, reads fail
        self._tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self._slave)
        if self._link is not None and os.path.lexists(self._link):
            left = self._link.is_symlink() and Path(os.readlink(self._link)).parent == Path(self.path).parent
            if not left:  # by an emulator that was killed
                cure = "choose another name for the emulated port (`live.create.port`)"
                expected = "a new name for the emulated port"
                raise InputError(str(self._link), "exists and is no emulated port", expected, cure)
        self.plugged = True
        if self._link is not None:
            new = temporary_path(self._link)
            with os_errors_of(self._link, "cannot be made", "a link"):
                new.symlink_to(self.path)
                new.replace(self._link)
            self.path = str(self._link)

    def has_create_baud_rate(self) -> bool:
        """Whether the client has set the Create's baud rate."""
        return bool(self._termios.tcgetattr(self._slave)[5] == getattr(self._termios, f"B{BAUD}"))

    def unplug(self) -> None:
        """Closes the terminal, as an unplugged cable would."""
        if self.plugged:
            self.plugged = False
            os.close(self.master)
            os.close(self._slave)
            if self._link is not None:
                self._link.unlink(missing_ok=True)
