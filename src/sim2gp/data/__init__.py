"""Data to learn from: transitions, and windows of logs."""

from sim2gp.data.split_log import cut as cut
from sim2gp.data.transitions import Transitions as Transitions
from sim2gp.data.windows import Windows as Windows
