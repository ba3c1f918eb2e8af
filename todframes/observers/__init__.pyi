from .decision import answer_probabilities as answer_probabilities
from .hotelling import HotellingObserver as HotellingObserver
from .interface import Observer as Observer
from .interface import Readout as Readout
from .interface import find_observer as find_observer
from .oriented import OrientedObserver as OrientedObserver
from .pyramid import PyramidObserver as PyramidObserver
