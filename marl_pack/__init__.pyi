# The public interface: __init__.py imports these names at their first use.

from .agents.keys import POLICIES as POLICIES
from .agents.player import Player as Player
from .agents.player import load as load
from .agents.policy import Policy as Policy
from .agents.search_settings import SearchSettings as SearchSettings
from .agents.selection.beam_settings import BeamSettings as BeamSettings
from .agents.selection.budget_settings import BudgetSettings as BudgetSettings
from .bins import Bins as Bins
from .env_aec import env as env
from .env_aec import parallel_env as parallel_env
from .env_aec import raw_env as raw_env
from .evaluation.statistics import strict_equilibrium as strict_equilibrium
from .exact.bins import ExactBins as ExactBins
from .exact.goods import Goods as Goods
from .exact.packing import ExactPacking as ExactPacking
from .exact.policies import make_exact_policy as make_exact_policy
from .exact.spec import ExactSpec as ExactSpec
from .exact.stable_place import stable_place as stable_place
from .game.packing import Packing as Packing
from .game.selection import SelectionPacking as SelectionPacking
from .game.spec import GameSpec as GameSpec
from .game.spec import SelectionSpec as SelectionSpec
from .game.turns import Outcome as Outcome
from .geometry import ORIENTATIONS as ORIENTATIONS
from .items import Items as Items
from .items import Stream as Stream
from .items import make_stream as make_stream
from .packer.answers import NoPlace as NoPlace
from .packer.answers import Placement as Placement
from .packer.answers import Waiting as Waiting
from .packer.packer import Packer as Packer
from .packer.poses import Pose as Pose
from .plan import Plan as Plan
from .sapien_check import Stack as Stack
from .sapien_check import check as check
from .stability import RULES as RULES
from .stability import OrientedItem as OrientedItem
from .stability import Rule as Rule
from .stability import make_rule as make_rule
from .stability import stable_mask as stable_mask

__version__: str
