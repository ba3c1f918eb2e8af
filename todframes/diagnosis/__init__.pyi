from .findings import frame_warnings as frame_warnings
from .inspection import inspect as inspect
from .locate import locate_triangles as locate_triangles
from .missing_threshold import explain_missing as explain_missing
