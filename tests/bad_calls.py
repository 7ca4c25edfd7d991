"""Bad inputs from 77 on: what Python is given, by what takes it."""

from bad_functions import FUNCTIONS
from bad_inputs import Case
from bad_settings import SETTINGS

CALLS: tuple[Case, ...] = (*SETTINGS, *FUNCTIONS)
