from .dataset import Dataset as Dataset
from .dataset import load_dataset as load_dataset
from .files import read_frame as read_frame
from .files import write_frame as write_frame
