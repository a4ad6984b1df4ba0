# __init__.py imports these names at their first use.

from .attributes import ATTRIBUTES as ATTRIBUTES
from .attributes import Attribute as Attribute
from .checking import check_items as check_items
from .cutting import cut as cut
from .generated import DEFAULT_SIDES as DEFAULT_SIDES
from .generated import GENERATED as GENERATED
from .items import Items as Items
from .sequences import Sequences as Sequences
from .sources import choose_stream as choose_stream
from .sources import load as load
from .sources import make_stream as make_stream
from .streams import Cut as Cut
from .streams import Drawn as Drawn
from .streams import Stream as Stream
from .streams import Uniform as Uniform
from .streams import fingerprint as fingerprint
from .streams import independent as independent
