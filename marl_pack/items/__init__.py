"""Items to be packed: their attributes, streams that bring them, and files of them."""

from marl_pack.items.checking import check_items
from marl_pack.items.cutting import cut
from marl_pack.items.items import ATTRIBUTES, Attribute, Items
from marl_pack.items.sequences import Sequences
from marl_pack.items.sources import DEFAULT_SIDES, GENERATED, choose_stream, load, make_stream
from marl_pack.items.streams import Cut, Drawn, Stream, Uniform, fingerprint, independent

__all__ = [
    "ATTRIBUTES",
    "DEFAULT_SIDES",
    "GENERATED",
    "Attribute",
    "Cut",
    "Drawn",
    "Items",
    "Sequences",
    "Stream",
    "Uniform",
    "check_items",
    "choose_stream",
    "cut",
    "fingerprint",
    "independent",
    "load",
    "make_stream",
]
