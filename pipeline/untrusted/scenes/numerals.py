"""Numbers in text from outside, without an object for each."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.files import UnusableFile


def numbers_in(text: bytes, where: str) -> npt.NDArray[np.float64]:
    """[N] the numbers of a text, parted by spaces or line breaks; eight bytes for each.

    Args:
        where: the part of the file, for the message.

    Raises:
        UnusableFile: there is something else in it.
    """
    if b"\0" in text:
        raise UnusableFile(f"holds zero bytes in {where}, which are no text")
    if text.isspace():  # of which numpy makes a number
        return np.zeros(0)
    try:
        with warnings.catch_warnings():  # older numpy only warns, and stops where it stopped
            warnings.simplefilter("error")
            return np.fromstring(text, np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        raise UnusableFile(f"holds something that is no number in {where}") from None
