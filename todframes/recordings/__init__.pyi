from .chart_layout import Chart as Chart
from .chart_layout import read_chart as read_chart
from .opening import open_recordings as open_recordings
from .recording import RecordedFrame as RecordedFrame
from .recording import Recording as Recording
from .schedule import ScheduledTrial as ScheduledTrial
from .schedule import read_schedule as read_schedule
