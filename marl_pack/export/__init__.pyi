# __init__.py imports these names at their first use.

from .command import main as main
from .writers import OUTPUTS as OUTPUTS
from .writers import Exported as Exported
from .writers import example as example
from .writers import export_afterstates as export_afterstates
from .writers import export_agent as export_agent
from .writers import export_onnx as export_onnx
