"""Project files: one TOML file names a machine, its priors and its logs; no code."""

from sim2gp.project.in_memory import project_and_logs as project_and_logs
from sim2gp.project.in_memory import project_of_machine as project_of_machine
from sim2gp.project.in_memory import read_logs as read_logs
from sim2gp.project.project import Project as Project
from sim2gp.project.project import load_project as load_project
from sim2gp.project.project import read_spec as read_spec
