from .fit import FitSettings as FitSettings
from .fit import PsychometricFit as PsychometricFit
from .fit import fit_counts as fit_counts
from .fit import fit_trials as fit_trials
