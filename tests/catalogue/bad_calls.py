"""Bad inputs from 77 on: what Python is given, by what takes it."""

from tests.catalogue.bad_commands import COMMANDS
from tests.catalogue.bad_formats import FORMATS
from tests.catalogue.bad_functions import FUNCTIONS
from tests.catalogue.bad_inputs import Case
from tests.catalogue.bad_machines import MACHINES
from tests.catalogue.bad_models import MODELS
from tests.catalogue.bad_project_files import PROJECT_FILES
from tests.catalogue.bad_settings import SETTINGS
from tests.catalogue.bad_streams import MESSAGES
from tests.catalogue.bad_sysid import SYSID
from tests.catalogue.bad_systems import SYSTEMS
from tests.catalogue.bad_written import WRITTEN

CALLS: tuple[Case, ...] = (
    *(*SETTINGS, *FUNCTIONS, *MODELS, *SYSID),
    *(*FORMATS, *PROJECT_FILES, *MACHINES, *MESSAGES),
    *SYSTEMS,
    *COMMANDS,
    *WRITTEN,
)
