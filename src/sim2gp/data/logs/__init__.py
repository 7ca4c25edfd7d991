"""Robot logs: files on disk become typed recordings in the system's names and units."""

from sim2gp.data.logs.budget import Budget as Budget
from sim2gp.data.logs.checks import check_all_used as check_all_used
from sim2gp.data.logs.checks import period_matches as period_matches
from sim2gp.data.logs.checks import shared_rows as shared_rows
from sim2gp.data.logs.formats import columns_of as columns_of
from sim2gp.data.logs.log import Column as Column
from sim2gp.data.logs.log import Log as Log
from sim2gp.data.logs.log import Note as Note
from sim2gp.data.logs.log import RawLog as RawLog
from sim2gp.data.logs.notes import note_lines as note_lines
from sim2gp.data.logs.read import read_log as read_log
from sim2gp.data.logs.resample import Resample as Resample
