"""The bodies of requests and answers, for validation and for the description of the API.

Options of bins come from :class:`marl_pack.exact.spec.ExactSpec`, and answers from the records of
the packer; so neither is listed here a second time.
"""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Annotated, Any, Literal, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, create_model
from pydantic import Field as Described

from marl_pack.checks import LARGEST_SEED
from marl_pack.exact.spec import ExactSpec
from marl_pack.option_record import options_of
from marl_pack.packer.answers import REASONS, NoPlace, Placement
from marl_pack.service.limits import LONGEST_ID, LONGEST_TEXT

LEFT_OUT = ("alpha", "beta")
"""Options that only training uses."""
BIN_ID = rf"^[A-Za-z0-9_][A-Za-z0-9._-]{{0,{LONGEST_ID - 1}}}$"
"""The form of a bin's id."""


class Model(BaseModel):
    """A body without conversions: a text is no number, and unknown keys are refused."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


Step = Annotated[
    int | None,
    Described(
        ge=0,
        description="The step at which the bin is expected to be. If it has changed since, the "
        "request is refused (409 wrong_step), and nothing is done.",
    ),
]
Text = Annotated[str, Described(max_length=LONGEST_TEXT)]
Number = Annotated[int, Described(ge=-(2**63), lt=2**63)]
Coordinate = Annotated[float, Described(ge=-1e9, le=1e9)]
AsTuple = Described(strict=False)  # a JSON list stands for a tuple; the values in it stay strict


class Change(Model):
    """What may stand in every request that changes a bin."""

    step: Step = None


class Box(Change):
    """A box as it comes."""

    sides: Annotated[tuple[float, float, float], AsTuple] = Described(
        description="The box's own sides w, d, h in millimetres."
    )
    id: Annotated[Text | Number | None, Described(description="A text or a number.")] = None
    weight: Annotated[float | None, Described(description="Kilograms.")] = None
    upright: Annotated[bool | None, Described(description="Whether it may not be tipped.")] = None
    orientations: Annotated[
        list[int] | None, Described(max_length=6, description="The allowed ones, from 0 to 5.")
    ] = None
    stackable: Annotated[bool | None, Described(description="Whether anything may rest on it.")] = (
        None
    )
    max_load: Annotated[
        float | None, Described(description="Kilograms of all boxes above it, at most.")
    ] = None
    order: Annotated[Text, Described(description="Name of its order; a bin takes one order.")] = ""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"sides": [400, 300, 250], "id": "A17", "weight": 8.2}]}
    )


class Actual(Change):
    """Where the robot really put the box that was placed last."""

    x: Annotated[Coordinate, Described(description="Middle of the box in the bin, millimetres.")]
    y: Coordinate
    yaw: Annotated[
        float, Described(description="Rotation in degrees, counterclockwise seen from above.")
    ] = 0.0
    id: Annotated[
        Text | Number | None,
        Described(description="Id of the box. If another was placed last: 409 other_box."),
    ] = None

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"x": 202.5, "y": 149.0, "yaw": 0.8, "id": "A17"}]}
    )


def _options() -> Any:
    """Return the model of the options of a bin; an absent one is the default."""
    found: Any = {}
    for each in options_of(ExactSpec):
        kind = get_type_hints(ExactSpec)[each.name]
        strict = False if get_origin(kind) is tuple else None  # as AsTuple
        field = Described(each.default, description=each.metadata["sentence"], strict=strict)
        if each.name not in LEFT_OUT:
            found[each.name] = (kind, field)
    return create_model("_Options", __base__=Model, **found)


_Options: Any = _options()


class OpenBin(_Options):
    """A new bin: its policy, and the options of its game."""

    id: Annotated[
        str | None, Described(pattern=BIN_ID, description="Its id; by default one is made.")
    ] = None
    policy: Annotated[
        Text,
        Described(description="A heuristic, search, a published model, or a policy of the server."),
    ] = "max_contact"
    plan: Annotated[
        Text | None, Described(description="Settings of a search, such as budget=200ms.")
    ] = None
    grid_mm: Annotated[
        float | None,
        Described(description="Edge of the cells on which trained agents see the bin."),
    ] = None
    seed: Annotated[
        int,
        Described(ge=0, le=LARGEST_SEED, description="Seed of the policies random and search."),
    ] = 0
    explain: Annotated[
        bool, Described(description="Whether the plan says why each box is where it is.")
    ] = False
    present: Annotated[
        dict[str, Any] | None,
        Described(description="A plan of one bin: boxes that are in it already."),
    ] = None

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"id": "pallet-7", "bin_mm": [1200, 800, 1500], "margin_mm": 20}]
        }
    )


KEYS = tuple({
    name: None for body in (Change, Box, Actual, OpenBin) for name in body.model_fields
})  # fmt: skip
"""All keys of bodies."""


# --- answers --------------------------------------------------------------------------------------


class Stepped(BaseModel):
    """What stands in every answer about one bin."""

    step: int = Described(
        description="Number of changes of the bin so far; an undo is a change, too."
    )


def _record(name: str, sentence: str, record: Any, example: Any) -> Any:
    """Return the model of an answer of the packer with the step."""
    hints = get_type_hints(record)
    known: Any = {
        each.name: (hints[each.name], ... if each.default is MISSING else each.default)
        for each in fields(record)
        if each.name != "number"  # only boxes that were shown have one
    }
    model = create_model(name, __doc__=sentence, __base__=Stepped, **known)
    model.model_config["json_schema_extra"] = {"examples": [example]}
    return model


Placed = _record(
    "Placed", "The box is placed. Lengths are in millimetres.", Placement,
    {
        "placed": True, "id": "A17", "bin": 0, "orientation": 0, "x": 0.0, "y": 0.0, "z": 0.0,
        "w": 400.0, "d": 300.0, "h": 250.0, "centre": [200.0, 150.0, 125.0], "support": 1.0,
        "margin": 150.0, "step": 1,
    },
)  # fmt: skip
NotPlaced = _record(
    "NotPlaced", f"The box has no place; nothing has changed. Codes: {', '.join(REASONS)}.",
    NoPlace,
    {
        "placed": False, "id": "A18", "code": "too_tall",
        "reason": "wherever it fits between the boxes, it would reach above the bin", "step": 1,
    },
)  # fmt: skip


class Opened(Stepped):
    """A bin is open."""

    id: str
    closed: bool


class Closed(Stepped):
    """A bin is closed."""

    closed: bool
    boxes: int = Described(description="Number of boxes in it.")


class Undone(Stepped):
    """The last place or actual is undone."""

    undone: Literal["place", "actual"]
    id: str = Described(description="Id of the box.")


class Listed(Stepped):
    """A bin in a list."""

    id: str
    opened: str = Described(description="Date and time, UTC.")
    closed: bool


class Listing(BaseModel):
    """Bins in the order in which they were opened."""

    bins: list[Listed]
    next: str | None = Described(description="Value of ``after`` for the next bins; null: no more.")


class State(Listed):
    """The bin so far."""

    policy: str
    boxes: int = Described(description="Number of boxes in it.")
    utilization: float = Described(description="Share of its volume that is filled.")
    weight: float = Described(description="Known weights in it, kilograms.")
    least_margin: float | None = Described(
        description="Smallest margin of a box that rests on others, in millimetres."
    )
    options: dict[str, Any] = Described(description="The options of the bin.")

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": "pallet-7", "opened": "2026-01-31T08:15:00+00:00", "closed": False,
                    "policy": "max_contact", "boxes": 2, "utilization": 0.083, "weight": 16.4,
                    "least_margin": 24.5, "step": 2, "options": {"bin_mm": [1200, 800, 1500]},
                }
            ]
        }
    )  # fmt: skip


class Error(BaseModel):
    """What was wrong."""

    code: str
    message: str = Described(description="One sentence that says what would be right.")


class ErrorAnswer(BaseModel):
    """Why a request was refused."""

    error: Error
