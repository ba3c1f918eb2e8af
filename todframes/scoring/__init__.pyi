from .naked_eye import acuity as acuity
from .naked_eye import contrast_threshold as contrast_threshold
from .score import ScoredDataset as ScoredDataset
from .score import score_dataset as score_dataset
