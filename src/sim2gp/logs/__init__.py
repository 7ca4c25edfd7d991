"""Robot logs: files on disk become typed recordings in the system's names and units."""

from sim2gp.logs.checks import period_matches as period_matches
from sim2gp.logs.checks import shared_rows as shared_rows
from sim2gp.logs.csv import read_csv as read_csv
from sim2gp.logs.log import Column as Column
from sim2gp.logs.log import Log as Log
from sim2gp.logs.log import Note as Note
