"""Reed-Solomon codes over bytes, interleaved over the whole message.

A message is dealt to as few codewords as it needs, byte by byte in turn, and so are the parity bytes: a burst, or a
lost packet, takes as little as possible from each. Codewords are shortened evenly. Systematic: what cannot be
corrected is passed on as it arrived.

Source: Reed and Solomon 1960; the codes (255, 223) and, of half the rate, (255, 127). Codec: reedsolo.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from common.errors import NotFoundError, hint
from common.extras import require
from common.surface import BoolArray, IntArray

LENGTH = 255
"""Bytes of a codeword before shortening."""


@cache
def _codec(parity: int) -> Any:
    require(f"a Reed-Solomon code ({LENGTH}, {LENGTH - parity})", "reedsolo", "codecs")
    from reedsolo import RSCodec

    return RSCodec(parity, nsize=LENGTH)


@dataclass(frozen=True, slots=True)
class Protection:
    """A Reed-Solomon code (255, 255 - parity), or none at all (parity 0).

    Corrects a codeword that holds e wrong bytes and f bytes known to be lost where 2 e + f <= parity.
    """

    name: str
    parity: int

    def payload(self, budget: int) -> int:
        """Most message bytes that, protected, fit into `budget` bytes; 0 where none do."""
        words = -(-budget // LENGTH) if self.parity else 0
        # With one codeword less the message may be longer than with a last one that is nearly all parity.
        fewer = (words - 1) * (LENGTH - self.parity) if self.parity else 0
        return max(0, budget - words * self.parity, fewer)

    def sent(self, message: int) -> int:
        """Bytes sent for a message of `message` bytes."""
        return message + self._words(message) * self.parity

    def _words(self, message: int) -> int:
        return -(-message // (LENGTH - self.parity))

    def encode(self, message: bytes) -> bytes:
        """The message, then the parity bytes of its codewords, interleaved; raises MissingExtraError."""
        if not self.parity:
            return message
        words = self._words(len(message))
        codec = _codec(self.parity)
        parities = [codec.encode(message[word::words])[-self.parity :] for word in range(words)]
        return message + b"".join(bytes(column) for column in zip(*parities, strict=True))

    def _words_of(self, total: int) -> int:
        return -(-total // LENGTH)

    def _codewords(self, total: int) -> list[IntArray]:
        """Positions of each codeword's bytes among `total`."""
        words = self._words_of(total)
        message = np.arange(total - words * self.parity)
        parity = np.arange(len(message), total).reshape(self.parity, words)
        return [np.concatenate([message[word::words], parity[:, word]]) for word in range(words)]

    def decode(self, received: bytes, lost: BoolArray, sent: bytes | None = None) -> tuple[bytes, BoolArray]:
        """The message, and which of its bytes are lost beyond correction.

        Parameters
        ----------
        received : bytes
            As long as what was sent; zeros stand for what is lost.
        lost : ndarray of bool, shape (len(received),)
        sent : bytes, optional
            What was sent, where a simulation knows it: errors are then counted by comparison where that tells as much,
            a hundred times faster. A codeword with more errors than can be corrected, and no losses, is taken as such:
            with the parities used here a decoder would find another codeword once in 10^13 times.
        """
        if not self.parity:
            return received, lost
        truth = None if sent is None else np.frombuffer(sent, dtype=np.uint8)
        data, gone = np.frombuffer(received, dtype=np.uint8).copy(), lost.copy()
        for positions in self._codewords(len(data)):
            word, missing = data[positions], gone[positions]
            if np.count_nonzero(missing) > self.parity:
                continue
            if truth is None:
                whole = self._corrected(word, missing)
            else:
                wrong = int(np.count_nonzero((word != truth[positions]) & ~missing))
                if 2 * wrong + np.count_nonzero(missing) <= self.parity:
                    whole = truth[positions]
                else:  # losses use up what would tell a wrong codeword from the right one: only decoding shows which
                    whole = self._corrected(word, missing) if missing.any() else None
            if whole is not None:
                data[positions], gone[positions] = whole, False
        length = len(data) - self._words_of(len(data)) * self.parity
        return data[:length].tobytes(), gone[:length]

    def _corrected(self, word: npt.NDArray[np.uint8], missing: BoolArray) -> npt.NDArray[np.uint8] | None:
        from reedsolo import ReedSolomonError

        try:
            whole = _codec(self.parity).decode(word.tobytes(), erase_pos=np.flatnonzero(missing).tolist())[1]
        except ReedSolomonError:
            return None
        return np.frombuffer(bytes(whole), dtype=np.uint8)


_ALL = (Protection("none", 0), Protection("rs223", 32), Protection("rs127", 128))

PROTECTIONS: Mapping[str, Protection] = MappingProxyType({protection.name: protection for protection in _ALL})
"""None, Reed-Solomon (255, 223) and (255, 127)."""


def find_protection(name: str) -> Protection:
    """The protection of that name; raises NotFoundError."""
    if name not in PROTECTIONS:
        raise NotFoundError(f"no protection is called {name!r}{hint(name, PROTECTIONS)}")
    return PROTECTIONS[name]
