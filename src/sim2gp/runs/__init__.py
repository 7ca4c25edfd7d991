"""Runs on disk: one commit protocol for results, progress and tables for people."""

from sim2gp.runs import sinks as sinks
from sim2gp.runs.progress import Progress as Progress
from sim2gp.runs.store import DiskError as DiskError
from sim2gp.runs.store import Run as Run
from sim2gp.runs.store import RunOwned as RunOwned
from sim2gp.runs.store import load_run as load_run
from sim2gp.runs.store import new_run as new_run
