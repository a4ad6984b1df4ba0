"""Calls are recorded, undone and done again: what a packer's file needs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from marl_pack.exact.present import Present
from marl_pack.exact.spec import ExactSpec
from marl_pack.files import write_json
from marl_pack.inputs import read_json
from marl_pack.packer import calls
from marl_pack.packer.calls import Call


class Journal(ABC):
    """A record of calls, from which its owner's state follows.

    Attributes:
        spec, arguments, present: what the owner was made of.
        calls: the calls that changed it, in order.
    """

    spec: ExactSpec
    arguments: dict[str, Any]
    present: Present
    calls: list[Call]

    @abstractmethod
    def _begin(self) -> None:
        """Put the owner into the state that it has before the first call."""

    @abstractmethod
    def _apply(self, call: Call) -> None:
        """Change the state by a call.

        Raises:
            ValueError: if it is impossible; nothing has changed then.
        """

    def _do(self, call: Call) -> None:
        """Do a call and record it; if it is impossible, nothing changes."""
        self._apply(call)
        self.calls.append(call)

    def undo(self) -> None:
        """Undo the last call that changed something, such as ``place``, ``show`` or ``actual``.

        Raises:
            ValueError: if there is none.
        """
        if not self.calls:
            raise ValueError("undo: nothing was done yet")
        self.replay(self.calls[:-1])

    def replay(self, done: Sequence[Call]) -> None:
        """Begin again and do calls, each of which is checked; if that fails, nothing changes.

        Args:
            done: calls that a packer with the same arguments recorded (:attr:`calls`).

        Raises:
            ValueError: if a call is impossible.
        """
        before = dict(vars(self))
        try:
            self._begin()
            for call in done:
                self._apply(call)
            self.calls = list(done)
        except ValueError:
            vars(self).update(before)
            raise

    def save(self, path: str | Path) -> None:
        """Write everything that :meth:`restore` needs to a JSON file.

        A function as the policy, and a catalogue that is not a file, are not saved: they have to be
        given to :meth:`restore`.
        """
        content = calls.to_dict(self.spec, self.arguments, self.present, self.calls)
        write_json(Path(path), content)

    @classmethod
    def restore(cls, path: str | Path, **arguments: Any) -> Self:
        """Return the packer that :meth:`save` wrote.

        The calls are done again and every placement is checked, so the file need not be trusted.

        Args:
            path: the file.
            **arguments: arguments of the packer that replace those in the file, such as ``policy``.

        Raises:
            ValueError: if the file is not such a file, or a call in it is impossible.
        """
        content = read_json(Path(path))
        try:
            made, rows = calls.read(content)
            packer = cls(**calls.complete(made, arguments))
            packer.replay([calls.of_row(row, packer.spec) for row in rows])
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        return packer
