# __init__.py imports these names at their first use.

from .boxes import ALL_ORIENTATIONS as ALL_ORIENTATIONS
from .boxes import MAX_HEIGHT as MAX_HEIGHT
from .boxes import MAX_SIDE as MAX_SIDE
from .boxes import ORIENTATIONS as ORIENTATIONS
from .boxes import Size as Size
from .boxes import check_size as check_size
from .tensor import orientation_table as orientation_table
from .tensor import oriented as oriented
from .windows import resting_heights_and_waste as resting_heights_and_waste
