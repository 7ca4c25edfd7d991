"""Project files: one TOML file names a machine, its priors and its logs; no code."""

from sim2gp.project.project import Project as Project
from sim2gp.project.project import load_project as load_project
from sim2gp.project.project import read_spec as read_spec
