# __init__.py imports these names at their first use.

from .arrays import stable_mask as stable_mask
from .oriented_item import OrientedItem as OrientedItem
from .oriented_item import orient_item as orient_item
from .rules import RULES as RULES
from .rules import Rule as Rule
from .rules import area_ratio as area_ratio
from .rules import equilibrium as equilibrium
from .rules import hull_1 as hull_1
from .rules import hull_alpha as hull_alpha
from .rules import lbcp as lbcp
from .rules import make_rule as make_rule
from .rules import none as none
from .static_equilibrium import in_equilibrium as in_equilibrium
