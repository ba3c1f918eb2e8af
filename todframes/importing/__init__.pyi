from .importing import Imported as Imported
from .importing import import_recordings as import_recordings
from .schedule import ScheduledTrial as ScheduledTrial
from .schedule import read_schedule as read_schedule
