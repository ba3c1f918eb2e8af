from .chart_layout import Chart as Chart
from .chart_layout import read_chart as read_chart
