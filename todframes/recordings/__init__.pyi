from .opening import open_recordings as open_recordings
from .recording import RecordedFrame as RecordedFrame
from .recording import Recording as Recording
