"""Calls that misbehave as decoders of damaged bytes do; a child process imports them."""

from __future__ import annotations

import os
import signal
import time

import numpy as np


def answer(value: int) -> int:
    """Say something on the terminal, as C libraries do, and answer."""
    os.write(1, b"decoder chatter\n")
    os.write(2, b"decoder chatter\n")
    return 2 * value


def leave(*_: object) -> None:
    """End the process before it says anything."""
    os._exit(3)


def misbehave(how: str) -> str:
    """Crash, leave, hang, gorge, refuse; anything else comes back."""
    match how:
        case "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "leave":
            os._exit(3)
        case "hang":
            time.sleep(600)
        case "gorge":
            np.ones(1 << 36, dtype=np.uint8)
        case "refuse":
            raise ValueError("damaged")
    return how
