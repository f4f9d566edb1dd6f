"""Array types, notices, and the one exception that a user's input can cause; it imports nothing
of the rest."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Vec3 = tuple[float, float, float]
TINY = 1e-12  # keeps a quotient or a logarithm finite; below any radiance or length in use


class Notice(NamedTuple):
    """Something about a capture or its maps that a person should know.

    code: a word for programs, the same in every version; text: one sentence for people.
    """

    code: str
    text: str


class InputError(ValueError):
    """Bad input. The message is one sentence: what is wrong and what to do about it.

    The command line prints it and exits with code 2.
    """
