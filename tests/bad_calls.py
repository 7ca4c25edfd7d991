"""Bad inputs from 77 on: what Python is given, by what takes it."""

from bad_commands import COMMANDS
from bad_formats import FORMATS
from bad_functions import FUNCTIONS
from bad_inputs import Case
from bad_machines import MACHINES
from bad_models import MODELS
from bad_project_files import PROJECT_FILES
from bad_settings import SETTINGS
from bad_streams import MESSAGES
from bad_sysid import SYSID
from bad_systems import SYSTEMS
from bad_written import WRITTEN

CALLS: tuple[Case, ...] = (
    *(*SETTINGS, *FUNCTIONS, *MODELS, *SYSID),
    *(*FORMATS, *PROJECT_FILES, *MACHINES, *MESSAGES),
    *SYSTEMS,
    *COMMANDS,
    *WRITTEN,
)
