"""Base class for resources that are closed at the end of a ``with`` block."""

from __future__ import annotations

from typing import Self


class Closing:
    """Object that a ``with`` block closes, whether or not the block raises an exception."""

    def close(self) -> None:
        """Release the resources."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
