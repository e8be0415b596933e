"""New configurations for datasets, chosen by what the trajectories show."""

from nmpm.data.new_configuration.choice import OPTIONS as OPTIONS
from nmpm.data.new_configuration.choice import Choice as Choice
from nmpm.data.new_configuration.choice import CompletedSource as CompletedSource
from nmpm.data.new_configuration.text import render_configuration as render_configuration
