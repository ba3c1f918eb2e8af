"""A writer of grey JPEG-LS images of 16 bits, from the standard alone: ITU-T T.87, annexes A and C.

With a `near` above 0 each value may be wrong by as much; `encoded` also returns the values that a reader has to
find.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

MAX_VALUE, BITS, LIMIT, RESET = 65535, 16, 64, 64
RUN_BITS = (*[0] * 4, *[1] * 4, *[2] * 4, *[3] * 4, 4, 4, 5, 5, 6, 6, 7, 7, *range(8, 16))


class Writer:
    """Bits, the first one highest; a byte 255 is followed by one of 7 bits (A.1)."""

    def __init__(self) -> None:
        self.data = bytearray()
        self._byte, self._free = 0, 8

    def put(self, value: int, n_bits: int) -> None:
        for place in range(n_bits - 1, -1, -1):
            self._free -= 1
            self._byte |= (value >> place & 1) << self._free
            if not self._free:
                self.data.append(self._byte)
                self._byte, self._free = 0, 7 if self._byte == 255 else 8

    def flush(self) -> None:
        if self._free < (7 if self.data[-1:] == b"\xff" else 8):
            self.data.append(self._byte)

    def golomb(self, value: int, k: int, limit: int, n_bits: int) -> None:
        """Write a value by the limited Golomb code (A.5.3)."""
        quotient = value >> k
        if quotient < limit - n_bits - 1:
            self.put(1, quotient + 1)
            self.put(value & (1 << k) - 1, k)
        else:
            self.put(1, limit - n_bits)
            self.put(value - 1, n_bits)


def encoded(
    values: NDArray[np.uint16], near: int = 0, thresholds: tuple[int, int, int] | None = None
) -> tuple[bytes, NDArray[np.uint16]]:
    """Encode an image. Returns the file, and the values that are in it.

    Parameters
    ----------
    values : array, (rows, columns)
    near : int
        Largest error.
    thresholds : (int, int, int), optional
        Differences from which a context is another one; default: the standard's own for 16 bits (C.2.4.1.1).
    """
    n_rows, n_columns = values.shape
    step = 2 * near + 1
    size = (MAX_VALUE + 2 * near) // step + 1
    n_bits = (size - 1).bit_length()
    thresholds = thresholds or (18 + 3 * near, 67 + 5 * near, 276 + 7 * near)
    sums, counts = [max(2, (size + 32) // 64)] * 367, [1] * 367
    biases, corrections, negatives = [0] * 365, [0] * 365, [0, 0]
    bits, run_index = Writer(), 0

    def region(difference: int) -> int:
        magnitude = abs(difference)
        number = 0 if magnitude <= near else 1 + sum(magnitude >= one for one in thresholds)
        return number if difference > 0 else -number

    def quantised(error: int) -> int:
        return (error + near) // step if error > 0 else -((near - error) // step)

    def wrapped(error: int) -> int:
        error += size if error < 0 else 0
        return error - size if error >= (size + 1) // 2 else error

    def k_of(context: int, total: int) -> int:
        k = 0
        while counts[context] << k < total:
            k += 1
        return k

    above, before_first = [0] * (n_columns + 1), 0
    found = np.zeros_like(values)
    for row in range(n_rows):
        line = [int(one) for one in values[row]]
        now = [0] * (n_columns + 1)
        column, left, corner = 0, above[0], before_first
        before_first = above[0]
        above[n_columns] = above[n_columns - 1]
        while column < n_columns:
            b, d = above[column], above[column + 1]
            regions = [region(d - b), region(b - corner), region(corner - left)]
            if not any(regions):  # run mode (A.7)
                start = column
                while column < n_columns and abs(line[column] - left) <= near:
                    now[column] = left
                    column += 1
                length = column - start
                while length >= 1 << RUN_BITS[run_index]:
                    bits.put(1, 1)
                    length -= 1 << RUN_BITS[run_index]
                    run_index = min(run_index + 1, 31)
                if column == n_columns:
                    bits.put(1, int(length > 0))
                    break
                bits.put(length, 1 + RUN_BITS[run_index])
                b = above[column]
                kind = int(abs(left - b) <= near)
                sign = -1 if not kind and left > b else 1
                guess = left if kind else b
                error = quantised(sign * (line[column] - guess))
                now[column] = min(max(guess + sign * error * step, 0), MAX_VALUE)
                error, context = wrapped(error), 365 + kind
                k = k_of(context, sums[context] + (counts[context] >> 1 if kind else 0))
                many = 2 * negatives[kind] >= counts[context]
                flip = (k == 0 and error > 0 and not many) or (error < 0 and (many or k != 0))
                mapped = 2 * abs(error) - kind - flip
                bits.golomb(mapped, k, LIMIT - RUN_BITS[run_index] - 1, n_bits)
                negatives[kind] += error < 0
                sums[context] += (mapped + 1 - kind) >> 1
                if counts[context] == RESET:
                    sums[context] >>= 1
                    counts[context] >>= 1
                    negatives[kind] >>= 1
                counts[context] += 1
                run_index = max(run_index - 1, 0)
            else:
                sign = -1 if next(one for one in regions if one) < 0 else 1
                first, second, third = (sign * one for one in regions)
                context = 81 * first + 9 * second + third
                guess = min(left, b) if corner >= max(left, b) else left + b - corner
                guess = max(left, b) if corner <= min(left, b) else guess
                guess = min(max(guess + sign * corrections[context], 0), MAX_VALUE)
                error = quantised(sign * (line[column] - guess))
                now[column] = min(max(guess + sign * error * step, 0), MAX_VALUE)
                error, k = wrapped(error), k_of(context, sums[context])
                if near == 0 and k == 0 and 2 * biases[context] <= -counts[context]:
                    mapped = 2 * error + 1 if error >= 0 else -2 * (error + 1)
                else:
                    mapped = 2 * error if error >= 0 else -2 * error - 1
                bits.golomb(mapped, k, LIMIT, n_bits)
                biases[context] += error * step
                sums[context] += abs(error)
                if counts[context] == RESET:
                    sums[context] >>= 1
                    biases[context] >>= 1
                    counts[context] >>= 1
                counts[context] += 1
                if biases[context] <= -counts[context]:
                    biases[context] = max(biases[context] + counts[context], 1 - counts[context])
                    corrections[context] = max(corrections[context] - 1, -128)
                elif biases[context] > 0:
                    biases[context] = min(biases[context] - counts[context], 0)
                    corrections[context] = min(corrections[context] + 1, 127)
            left, corner = now[column], above[column]
            column += 1
        above = now
        found[row] = now[:n_columns]
    bits.flush()
    frame = struct.pack(">HBHHBBBB", 11, BITS, n_rows, n_columns, 1, 1, 0x11, 0)
    presets = struct.pack(">HBHHHHH", 13, 1, MAX_VALUE, *thresholds, RESET)
    scan = struct.pack(">HBBBBBB", 8, 1, 1, 0, near, 0, 0)
    head = b"\xff\xd8\xff\xf7" + frame + b"\xff\xf8" + presets + b"\xff\xda" + scan
    return head + bytes(bits.data) + b"\xff\xd9", found
