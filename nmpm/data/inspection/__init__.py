"""What a dataset holds and what is odd about it, found by looking at every trajectory once."""

from nmpm.data.inspection.dataset import inspect as inspect
from nmpm.data.inspection.facts import Inspection as Inspection
