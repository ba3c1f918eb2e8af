from .algorithm import Enhancement as Enhancement
from .algorithm import enhancement_names as enhancement_names
from .algorithm import find_enhancement as find_enhancement
from .algorithm import parameter as parameter
from .compare import compare_dataset as compare_dataset
