from .layout import Chart as Chart
from .layout import read_chart as read_chart
