"""The bins of a server: :class:`Service`.

The file is the truth: a request is written to it before it is answered, and a bin whose request
could not be written is forgotten in memory and made again from the file. Requests to one bin are
done one after the other, in the order in which they arrived; different bins do not wait for each
other, and reading a bin does not wait until a policy has decided.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any, TypeVar
from uuid import uuid4
from weakref import WeakValueDictionary

from marl_pack.checks import shown
from marl_pack.exact.spec import ExactSpec
from marl_pack.option_record import options_of
from marl_pack.packer import calls
from marl_pack.packer.answers import Placement
from marl_pack.packer.packer import Packer
from marl_pack.plan import Plan
from marl_pack.service.limits import ServiceLimits
from marl_pack.service.policies import Policies
from marl_pack.service.refusals import Refusal, checking_values
from marl_pack.service.store import BinRow, Entry, Keyed, Store

T = TypeVar("T")
THREADS = 64
"""Bins that may change at once."""
READERS = 4
"""Bins that may be read at once, also while all threads above are busy."""
SHORTEST_MM = 5
"""Shortest longest side of a box; a shorter one is in metres or centimetres."""
OPTIONS = tuple(each.name for each in options_of(ExactSpec))


@dataclass(frozen=True)
class Answer:
    """An answer for a client."""

    text: str  # JSON
    replayed: bool = False  # whether it is the stored answer to an earlier request


class Bin:
    """A bin that requests are using, or used a short time ago.

    Attributes:
        id: its id.
        turn: held while a request is done; those that wait get it in the order of arrival.
        changing: held while the bin changes or is read. A policy decides without it.
        row: the bin as it is stored; None before it is read.
        packer: its packer; None before it is made from the file.
    """

    def __init__(self, id: str) -> None:
        self.id = id
        self.turn = asyncio.Lock()
        self.changing = threading.Lock()
        self.row: BinRow | None = None
        self.packer: Packer | None = None
        self.step, self.closed = 0, False
        self.keys: set[str] = set()  # idempotency keys that were used


def dump(value: Any) -> str:
    """Return a value as compact JSON."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def digest(kind: str, body: Any) -> bytes:
    """Return a digest of a request, to tell equal requests from others."""
    text = json.dumps([kind, body], sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).digest()


class Service:
    """The bins of a server.

    Args:
        store: the file.
        limits: how much clients may ask for.
        policies: names or files of policies that are allowed besides the built-in ones.
    """

    def __init__(
        self, store: Store, limits: ServiceLimits | None = None, policies: Sequence[str] = ()
    ) -> None:
        self.store = store
        self.limits = limits or ServiceLimits()
        self.policies = Policies(policies, self.limits.max_budget_ms)
        self._bins: WeakValueDictionary[str, Bin] = WeakValueDictionary()
        self._recent: OrderedDict[str, Bin] = OrderedDict()  # keeps bins in memory
        self._open = store.count_open()
        self._opening = threading.Lock()
        self._pool = ThreadPoolExecutor(THREADS, "bin")
        self._readers = ThreadPoolExecutor(READERS, "reader")

    def close(self) -> None:
        """Finish what is being done, and close the file."""
        self._pool.shutdown()
        self._readers.shutdown()
        self.store.close()

    async def _run(self, work: Callable[..., T], *arguments: Any) -> T:
        """Do work in a thread."""
        return await asyncio.get_running_loop().run_in_executor(self._pool, work, *arguments)

    def _bin(self, id: str) -> Bin:
        """Return a bin by its id, whether it exists or not; call it in the event loop."""
        bin = self._bins.get(id)
        if bin is None:
            bin = self._bins[id] = Bin(id)
        return bin

    def _keep(self, bin: Bin) -> None:
        """Keep a bin in memory, and forget those that were used longest ago."""
        self._recent[bin.id] = bin
        self._recent.move_to_end(bin.id)
        while len(self._recent) > self.limits.in_memory:
            self._recent.popitem(last=False)

    # --- bins -------------------------------------------------------------------------------------

    async def open(self, body: dict[str, Any], key: str | None) -> Answer:
        """Open a bin.

        Args:
            body: the keys of :class:`marl_pack.service.models.OpenBin` that the client gave.
            key: an idempotency key.
        """
        return await self._run(self._do_open, body, key)

    def _do_open(self, body: dict[str, Any], key: str | None) -> Answer:
        with self._opening:
            keyed = None if key is None else Keyed(key, digest("open", body))
            if keyed is not None and (before := self.store.opening(keyed.key)):
                return _again(keyed, before)
            if self._open >= self.limits.max_bins:
                raise Refusal(
                    "too_many_bins",
                    f"{self._open} bins are open, as many as may be (max_bins); close one first",
                )
            id = body.get("id") or uuid4().hex
            if self.store.bin(id) is not None:
                raise Refusal("exists", f"id {shown(id)}: there is a bin with this id already")
            arguments = {name: value for name, value in body.items() if name != "id"}
            with checking_values():
                packer = self._packer(arguments)
            arguments |= {**asdict(packer.spec), "policy": body.get("policy", "max_contact")}
            text = dump({"id": id, "step": 0, "closed": False})
            opened = datetime.now(UTC).isoformat(timespec="seconds")
            self.store.add_bin(id, opened, dump(arguments), text, keyed)
            self._open += 1
            return Answer(text)

    def _packer(self, arguments: dict[str, Any]) -> Packer:
        """Return the packer of a new bin.

        Raises:
            ValueError: if an argument is impossible; says what would be right.
        """
        options = {name: arguments[name] for name in OPTIONS if name in arguments}
        if "bin_mm" in options and 0 < max(options["bin_mm"]) < 10 * SHORTEST_MM:
            raise ValueError(
                f"bin_mm {shown(options['bin_mm'])}: below {10 * SHORTEST_MM} mm; lengths are in "
                "millimetres"
            )
        most = self.limits.max_boxes
        spec = ExactSpec(**{"max_boxes": min(most, 256), **options})
        if spec.max_boxes > most:
            raise ValueError(
                f"max_boxes = {spec.max_boxes}: this server allows at most {most} (max_boxes)"
            )
        present = arguments.get("present")
        policy = self.policies.make(
            arguments.get("policy", "max_contact"), spec, arguments.get("plan"),
            arguments.get("grid_mm"), arguments.get("seed", 0),
        )  # fmt: skip
        boxes = () if present is None else Plan.of_dict(present, "present")
        explain = arguments.get("explain", False)
        return Packer(policy=policy, spec=spec, present=boxes, explain=explain)

    def list(self, after: str | None, limit: int) -> dict[str, Any]:
        """Return bins in the order in which they were opened, those after bin ``after``."""
        number = 0 if after is None else self._row(after).number
        rows = self.store.bins(number, limit + 1)
        listed = [
            {"id": row.id, "opened": row.opened, "step": row.step, "closed": row.closed}
            for row in rows[:limit]
        ]
        return {"bins": listed, "next": listed[-1]["id"] if len(rows) > limit else None}

    def latest(self, limit: int) -> Sequence[BinRow]:
        """Return the bins that were opened last, the last one first."""
        return self.store.latest(limit)

    def _row(self, id: str) -> BinRow:
        row = self.store.bin(id)
        if row is None:
            raise Refusal(
                "unknown_bin", f"bin {shown(id)}: there is no such bin; POST /bins opens one"
            )
        return row

    def _load(self, bin: Bin) -> BinRow:
        """Read what the file says of a bin; ``changing`` is held.

        Raises:
            Refusal: if there is no such bin.
        """
        if bin.row is None:
            bin.row = self._row(bin.id)
            bin.step, bin.closed = bin.row.step, bin.row.closed
            bin.keys = self.store.keys(bin.row.number)
        return bin.row

    def _restored(self, bin: Bin) -> Packer:
        """Return the packer of a bin, made from its calls if need be; ``changing`` is held."""
        row = self._load(bin)
        if bin.packer is None:
            done: list[str] = []
            for kind, call in self.store.changes(row.number):
                if call is not None:
                    done.append(call)
                elif kind == "undo":
                    done.pop()
            try:
                packer = self._packer(json.loads(row.arguments))
                packer.replay([calls.of_row(json.loads(call), packer.spec) for call in done])
            except (ValueError, FileNotFoundError) as error:
                raise Refusal("unavailable", f"bin {shown(bin.id)}: {error}") from error
            bin.packer = packer
        return bin.packer

    # --- reading ----------------------------------------------------------------------------------

    async def read(self, id: str, work: Callable[[Bin, Packer], T]) -> T:
        """Return what ``work`` reads of a bin, in a thread.

        Raises:
            Refusal: if there is no such bin.
        """
        bin = self._bin(id)

        def reading() -> T:
            with bin.changing:
                return work(bin, self._restored(bin))

        result = await asyncio.get_running_loop().run_in_executor(self._readers, reading)
        self._keep(bin)
        return result

    # --- changing ---------------------------------------------------------------------------------

    async def offer(self, id: str, body: dict[str, Any]) -> Answer:
        """Return what ``place`` would do with a box."""
        bin = self._bin(id)
        async with bin.turn:
            answer = await self._run(self._do_offer, bin, body)
        self._keep(bin)
        return answer

    def _do_offer(self, bin: Bin, body: dict[str, Any]) -> Answer:
        box = dict(body)
        with checking_values():
            check_box(box)
        with bin.changing:
            packer = self._restored(bin)
            self._check(bin, box.pop("step", None))
        with checking_values():
            answer = packer.offer(**box)
        return Answer(dump({**answer.to_dict(), "step": bin.step}))

    async def change(self, id: str, kind: str, body: dict[str, Any], key: str | None) -> Answer:
        """Change a bin: place a box, report where it is, undo, or close the bin.

        Args:
            id: the bin.
            kind: a key of :data:`CHANGES`.
            body: what the client gave.
            key: an idempotency key.

        Raises:
            Refusal: if that is impossible now; nothing has changed then.
            ValueError: if a value is impossible; says what would be right.
        """
        bin = self._bin(id)
        async with bin.turn:
            answer = await self._run(self._do_change, bin, kind, body, key)
        self._keep(bin)
        return answer

    def _do_change(self, bin: Bin, kind: str, body: dict[str, Any], key: str | None) -> Answer:
        keyed = None if key is None else Keyed(key, digest(kind, body))
        arguments = dict(body)
        with bin.changing:
            number = self._load(bin).number
            if keyed is not None and keyed.key in bin.keys:
                return _again(keyed, self.store.answered(number, keyed.key))
            self._check(bin, arguments.pop("step", None), kind in ("place", "actual"))
            packer = self._restored(bin)
        if kind == "place":
            with checking_values():
                check_box(arguments)
                packer.offer(**arguments)  # the policy decides, while others may read the bin
        with bin.changing:
            return self._commit(bin, packer, kind, arguments, keyed)

    def _commit(
        self, bin: Bin, packer: Packer, kind: str, arguments: dict[str, Any], keyed: Keyed | None
    ) -> Answer:
        """Change a bin and write it to the file, or do neither; ``changing`` is held."""
        row, count = self._load(bin), len(packer.calls)
        try:
            with checking_values():
                answer, changed = CHANGES[kind](packer, arguments)
            step = bin.step + changed
            made = len(packer.calls) > count
            call = dump(calls.to_row(packer.calls[-1])) if made else None
            text = dump({**answer, "step": step})
            if changed or keyed is not None:
                entry = Entry(kind, text, step if changed else None, call, keyed)
                self.store.add(row.number, entry)
        except BaseException:
            if len(packer.calls) != count:  # memory must not know more than the file
                bin.row = bin.packer = None
            raise
        bin.step = step
        if keyed is not None:
            bin.keys.add(keyed.key)
        if kind == "close":
            bin.closed = True
            with self._opening:
                self._open -= 1
        return Answer(text)

    def _check(self, bin: Bin, step: int | None, grows: bool = False) -> None:
        """Refuse a change of a bin that is closed, is full of changes, or has another step.

        Args:
            bin: the bin.
            step: the step that the client expects; None for any.
            grows: whether the change needs a place among the largest number of changes.
        """
        if bin.closed:
            raise Refusal("closed", f"bin {shown(bin.id)} is closed; it can only be read")
        if step is not None and step != bin.step:
            raise Refusal(
                "wrong_step",
                f"step = {step}: the bin is at step {bin.step}; read it and decide again",
            )
        if grows and bin.step >= self.limits.max_steps:
            raise Refusal(
                "too_many_steps",
                f"the bin has {bin.step} changes, as many as it may (max_steps); close it",
            )


def _again(keyed: Keyed, before: tuple[bytes, str]) -> Answer:
    """Return a stored answer.

    Raises:
        Refusal: if it is the answer to another request.
    """
    if before[0] != keyed.digest:
        raise Refusal(
            "key_reused",
            f"Idempotency-Key {shown(keyed.key)}: was used for another request; needs a new key",
        )
    return Answer(before[1], replayed=True)


def check_box(body: dict[str, Any]) -> None:
    """Refuse a box whose sides are surely not in millimetres.

    Raises:
        ValueError: if its longest side is below :data:`SHORTEST_MM`.
    """
    if 0 < max(body["sides"]) < SHORTEST_MM:
        sides = shown(body["sides"])
        raise ValueError(f"sides {sides}: below {SHORTEST_MM} mm; lengths are in millimetres")


# --- what a request does to the packer ------------------------------------------------------------


def _place(packer: Packer, body: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    answer = packer.place(**body)
    return answer.to_dict(), isinstance(answer, Placement)


def _last_id(packer: Packer) -> str:
    return packer.placements[-1].id if packer.calls else ""


def _actual(packer: Packer, body: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    if not packer.calls:
        raise Refusal("nothing_done", "actual: no box was placed yet")
    id, last = body.get("id"), _last_id(packer)
    if id is not None and str(id) != last:
        raise Refusal("other_box", f"id {shown(id)}: the box placed last is {shown(last)}")
    pose = body["x"], body["y"], body.get("yaw", 0.0)
    return packer.actual(pose).to_dict(), True


def _undo(packer: Packer, body: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    if not packer.calls:
        raise Refusal("nothing_done", "undo: nothing was done yet")
    undone = {"undone": calls.to_row(packer.calls[-1])["call"], "id": _last_id(packer)}
    packer.undo()
    return undone, True


def _close(packer: Packer, body: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    return {"closed": True, "boxes": len(packer.placements)}, True


CHANGES: dict[str, Callable[[Packer, dict[str, Any]], tuple[dict[str, Any], bool]]] = {
    "place": _place, "actual": _actual, "undo": _undo, "close": _close,
}  # fmt: skip
"""For each kind of change what it does: returns the answer, and whether the bin changed."""
