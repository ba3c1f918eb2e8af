from .result import Result as Result
from .result import load_result as load_result
