"""The constants of the diagnosis, each with its derivation or with the measurement that set it."""

from __future__ import annotations

import math

import numpy as np

# Windows of frames

PICTURE_BLOCKS_PER_SIZE = 8
"""Number of square blocks along a triangle's size that its picture is reduced to; fewer if these are pixels."""

REACH_IN_SIZES = 3.0
"""Distance from the stated place that a window has, in sizes."""

# The fit of a triangle

DEGREE = 2
"""Degree of the polynomial background."""

FITTED_REACH_IN_SIZES = 2.2
"""Half of the side of the square that is fitted, in sizes; corners lie at 0.88."""

CELL = 2.2
"""Side of the square, in sizes, that counts as one independent value of the noise as a fit sees it, set by
`tests/triangles.py`: reported 95 % intervals hold 96.8 % of true values, and 92.6 % with 1.5."""

MOST_ROUGH = 2.0
"""Largest factor of the covariance for what a fit leaves at the edges of a triangle, the power there over that
elsewhere: pictures with little blur are not quite exact there, and in little noise that is 1.0 to 1.3 times it.
More is a mishap, such as trials without a triangle."""

MOST_ROUNDS = 12
"""Largest number of steps of a fit."""

FOUND = 2e-4
"""Last step of the fit, in sizes and radians; the errors that matter are a hundred times as large."""

LEAST_VARIANCE = -0.05
"""Least variance of the blur, in blocks: sharpened pictures have a negative one."""

MOST_STRETCH = 1.5
"""Largest ratio of an axis of the map to the mean of the two: a picture seen from 60° to the side has 1.41."""

MOST_BESIDE_TURN_RAD = math.radians(8.0)
"""Largest rotation beside a quarter turn: a triangle turned by 25° is one turned by -90° and by 5° back."""

SEPARABLE = 1.2
"""Least ratio of the highest level to the lowest at which the part that all frames share can be separated."""

UNSTEADY = 2.0
"""Standard deviation of a block around the triangle over trials, in those of the noise there, beyond which it
counts less: letters that change from frame to frame then count no more than the noise does elsewhere."""

LEAST_APART = 1e-3
"""Least difference of stated places, in blocks, and of sizes for frames to be aligned: a twentieth of what fits of
single frames resolve."""

SIZES_TRIED = np.geomspace(0.25, 5.0, 11)
"""Sizes that are tried, as multiples of the stated one."""

# What a group shows

MOST_SAMPLED, LEAST_SAMPLED = 24, 8
"""Most and fewest trials of a stimulus in a group that are measured."""

SAMPLED, SAMPLED_SHARE = 96, 0.04
"""Number of frames that are measured in all, and their share of the frames if that is more."""

VIEWED_TIMES, MOST_OF_VIEW = 3, 8
"""Number of trials with scenes that are measured, in those on even backgrounds, and of those of one background if
there are many: with eight, its error adds an eighth to the variance of the noise."""

MOST_BLUR_PER_SIZE = 0.22
"""Largest blur, in sizes, at which contrast and size are judged by the differences of orientations alone: from
0.29 on, fits of blurred triangles of 4 pixels end with contrasts off by half, and sizes off by a tenth."""

LEAST_SCENES = 4
"""Least number of scenes whose mean tells what all frames share, such as dirt, from what a scene shows."""

USABLE_CONTRASTS = (1e-9, 1e9)
"""Range of contrasts that are computed with; beyond it are mistakes in a manifest, whose squares may overflow."""

SIZES_ALIKE = 1.15
"""Ratio of the largest stated size of a curve to the least up to which they are one size in perspective: a chart
tilted by 10° in a field of view of 28° has 1.09."""

LEAST_SIZE = 1e-9
"""Least size in blocks that is computed with; smaller ones are mistakes, and ratios to them overflow."""

CLEAR, OFF_LEVEL = 0.1, 0.4
"""Largest error of a trial's contrast or place that shows it clearly, relative to the contrast and the size, and
the relative deviation of a contrast that does not follow its level."""

CERTAIN_TURN, CLEARLY_TURNED = 5.0, 8.0
"""Least advantage of another orientation than stated, in standard errors: of a group, and of a single trial."""

WHOLE_IN_SIZES = 1.2
"""Distance from the centroid within which all frames must have pixels for size and contrast to be judged."""

LEAST_SIGNAL = 8.0
"""Least contrast of the triangle, in standard errors, for its place, size and orientation to be measured."""

ROUNDING = 1e-6
"""Contrast that equal frames may leave: luminance has single precision, 6e-8 of itself."""

SCATTER_ERRORS = 5.0
"""Least scatter over trials that is more than noise, in standard errors."""

# Warnings

CERTAIN = 5.0
"""Least deviation that is reported, in standard errors."""

MATTERS = 0.03
"""Relative error of a threshold that matters."""

MOST_BY_PATTERN = 3.0
"""Largest relative deviation of a background's luminance that noise and a fixed pattern may cause, in standard
deviations of a pixel's contrast, from its neighbours and from trial to trial; a larger one is a step or a slope of
the background."""

SKEW = 0.5
"""Relative deviation of a background's luminance that skewed noise may cause, in standard deviations of a pixel's
contrast."""

OFFSET_MRAD, SCATTER_MRAD = 0.08, 0.1
"""Offset and scatter of the triangle's place that matter: half a sample of the naked eye's retina raises
thresholds by 2 to 5 % for sizes up to 4 mrad, and more for larger ones."""

LEAST_OFFSET_PX = 0.05
"""Least offset that is reported, in pixels; a smaller one is within the errors of the fit."""

OFFSET_PER_BLUR = 0.3
"""Offset of a blurred triangle that does not matter, in standard deviations of its blur."""

SIZE_MRAD, LEAST_SIZE_ERROR = 0.08, 0.02
"""Error of a size that matters, and the least relative one that is reported."""

SIZE_SCATTER = 0.2
"""Relative scatter of a size over trials beyond which a group has triangles of several sizes."""

SIZE_PER_BLUR = 1.5
"""Relative scatter of a size that sampling may cause, in standard deviations of the blur per size."""

MOST_TURN_RAD = math.radians(2.0)
"""Largest rotation that is not reported: thresholds rise by its square, by about a sixth at 5°."""

SCATTER_PER_BLUR = 0.4
"""Scatter of the place that sampling may cause, in standard deviations of the triangle's blur."""

CONTRAST_ERROR = 0.05
"""Relative deviation of the displayed contrast from the level that is reported."""

LEAST_DISPLAYED_SIZE_PX = 2.0
"""Size of a triangle in pixels below which its orientation is not displayed."""

MOST_CLIPPED, MOST_CLIPPED_NOISE, LOUD = 0.002, 0.01, 0.1
"""Share of the triangle's pixels at an end of the code values that is reported: of quiet frames, and of loud ones,
whose noise reaches that end. Loud is a noise of that contrast."""

SKEWED = 0.1
"""Relative deviation of the background's luminance in loud frames, from noise cut off or a fixed pattern."""

UNEVEN_PER_LEVEL, TIMES_TEXTURE = 0.15, 4.0
"""Contrast of the background's own structure at the triangle that matters, relative to the median level, and to
the same structure elsewhere in the picture: a camera's fixed pattern is everywhere."""

COARSE_PER_LEVEL, DITHERED = 0.5, 0.6
"""Contrast of one code step that matters, relative to the median level, and the noise in steps that smooths it."""

BIT_DEPTHS = (10, 12, 14)
"""Bits of values that cameras store in files of 16 bits."""

# The search of whole frames

MOST_LOCATED_PX = 2**21
"""Largest number of pixels of a frame that is searched pixel by pixel; a larger one is averaged over blocks."""

BLOCKS = 2**19
"""Number of square blocks of pixels that a large frame is divided into."""

MOST_BLOCKS = 2**24
"""Largest number of blocks of a frame; more would fill the memory."""

CLEAR_PEAK = 100.0
"""Height of a correlation peak, in standard deviations of the correlation, above which noise does not count."""

LEAST_BLOCKS = 16
"""Least number of blocks along a triangle's size, unless blocks are pixels: larger blocks blur its edges."""

# Positions

LEAST_PEAK = 6.0
"""Least height of a correlation peak above its surroundings, in their standard deviations."""

MOST_FITTED = 256
"""Largest number of trials, the strongest, that the triangle of a group is fitted to."""

MOST_STRONGEST = 24
"""Number of the strongest trials that are searched over whole frames for positions of their own."""

LEAST_SURE_TRIALS = 4
"""Least number of these with a high peak from which the middle of the positions is known."""

STRONG = 0.5
"""Least level, as a share of the highest, of trials in which the triangle is looked for before it is known."""

SEARCHED, LEAST_SEARCHED_PX = 2.5, 8.0
"""Largest distance of a trial's position from where its search begins: so many sizes, and pixels more."""

NEARBY = 4.0
"""The same distance in standard deviations of the positions, if that is larger."""

MOST_ERROR_MRAD = 0.09
"""Standard error of single positions along an axis from which they raise a threshold by more than 3 %: between
0.1 and 0.15 of noise in docs/validation.md."""

# Positions of single trials

MOST_PEAKS = 12
"""Largest number of peaks of a trial that are kept."""

CLEAR_LIKELIHOOD, CLEAR_LEAD = 18.0, 5.0
"""Least log likelihood of a peak, that of six standard deviations, and its least lead over the next, for a trial
whose place is clear without the others."""

LIKELY = 0.5
"""Least probability of a peak for a trial to have a place of its own."""

LEAST_CLEAR = 4
"""Least number of clear trials from which the scatter is estimated."""

NEIGHBOURS = 16
"""Number of trials, the nearest in time, from which a place is predicted."""

MOST_CLEAR_FITTED = 240
"""Largest number of clear trials that memory and scatter are fitted to."""

MEMORIES = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Times after which a place is forgotten, in median distances of the trials, that are tried."""

JITTERS = (0.0, 0.03, 0.2)
"""Shares of the variance without memory that are tried."""

# Missing thresholds

SIZES_SOUGHT = tuple(np.geomspace(1.0 / 20.0, 20.0, 15).tolist())
"""Sizes that are sought on whole frames, as multiples of the stated one: degrees or minutes of arc taken for mrad
are 0.06 to 17.5 times. Steps of 1.53 lose at most a fifth of the correlation's height."""

LEAST_TRIALS, MOST_TRIALS = 8, 32
"""Least number of strong trials, as far as a group has them, and the largest number that are looked at again."""

STRONG_SHARE = 1.0 / 3.0
"""Share of the levels, the highest ones, whose trials are strong."""

LEAST_RIGHT, LEAST_GAIN = 0.75, 0.2
"""Least share of right answers after a change, and least gain, for a hint."""

LEAST_OFFSET = 0.1
"""Least distance from the stated position, and least scatter of positions, in sizes, for a hint at positions."""

LEAST_EVIDENCE = math.log(1e4)
"""Least log likelihood ratio against guessing, for a hint; some thirty changes are tried."""

MOST_GRID_SIDE = 2049
"""Largest side of the retina grid, in samples, with which another size is tried."""
