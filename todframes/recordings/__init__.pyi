from .schedule import ScheduledTrial as ScheduledTrial
from .schedule import read_schedule as read_schedule
