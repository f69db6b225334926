"""What is finished, kept in a file that survives being killed at any moment."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certbound.simulation.blocks import Tally, Work, entropy_of
from certbound.simulation.compiled import write_atomically

_VERSION = 1
_KEYS = ("version", "problem", "number of paths", "seed", "chunk size")
_ARRAYS = ("done", "counts", "marginals", "steps", "finished")


@dataclass(eq=False, kw_only=True, slots=True)
class Checkpoint:
    """Chunks done so far and their tally; ``path`` None keeps them in memory only."""

    path: Path | None
    work: Work
    chunk: int
    done: NDArray[np.bool_]
    tally: Tally
    paths_before: int = 0

    @classmethod
    def fresh(cls, work: Work, chunk: int, path: Path | None = None) -> Checkpoint:
        """Nothing done yet."""
        done = np.zeros(-(-work.blocks // chunk), dtype=bool)
        return cls(path=path, work=work, chunk=chunk, done=done, tally=work.tally())

    @classmethod
    def open(cls, path: str | Path, work: Work, chunk: int) -> Checkpoint:
        """Continue an existing file, or start one.

        Raises
        ------
        ValueError
            If the file is not a checkpoint of this work; it is left as it is.
        """
        path = Path(path)
        record = cls.fresh(work, chunk, path)
        if not path.parent.is_dir():
            raise ValueError(f"`checkpoint` must lie in an existing folder, got {path}.")
        for left_over in path.parent.glob(f".{path.name}.*"):  # of a run that was killed while writing
            left_over.unlink(missing_ok=True)
        if not path.exists():
            return record
        stored = _read(path)
        for name, mine in record._keys().items():
            if str(stored[name]) != mine:
                raise ValueError(
                    f"`checkpoint` {path} belongs to another {name} ({_short(str(stored[name]))}, here "
                    f"{_short(mine)}); choose another file, or delete it."
                )
        record.done = np.unpackbits(stored["done"])[: len(record.done)].astype(bool)
        record.tally = Tally(
            counts=stored["counts"],
            marginals=stored["marginals"],
            steps=int(stored["steps"]),
            paths=int(stored["finished"]),
        )
        record.paths_before = record.tally.paths
        return record

    def _keys(self) -> dict[str, str]:
        work = self.work
        values = (_VERSION, work.digest(), work.paths, work.entropy, self.chunk)
        return dict(zip(_KEYS, map(str, values), strict=True))

    def missing(self) -> list[int]:
        """Numbers of the chunks still to do."""
        return [int(number) for number in np.flatnonzero(~self.done)]

    def add(self, number: int, tally: Tally) -> None:
        """Take in a finished chunk."""
        self.done[number] = True
        self.tally = self.tally + tally

    def save(self) -> None:
        """Write the file, all of it or nothing."""
        if self.path is None:
            return
        tally = self.tally
        values = (np.packbits(self.done), tally.counts, tally.marginals, np.array(tally.steps), np.array(tally.paths))
        arrays = {name: np.array(value) for name, value in self._keys().items()}
        arrays |= dict(zip(_ARRAYS, values, strict=True))
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **arrays)
        write_atomically(self.path, buffer.getvalue())


def _short(text: str) -> str:
    return text if len(text) <= 12 else text[:12] + "..."


def _read(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(
            f"`checkpoint` {path} is not a checkpoint of certbound ({error}); choose another file."
        ) from error
    if not {*_KEYS, *_ARRAYS} <= set(stored):
        raise ValueError(f"`checkpoint` {path} is not a checkpoint of certbound; choose another file.")
    return stored


def seed_of(rng: np.random.Generator | int | None, path: str | Path | None) -> int:
    """The seed of a run: that of an existing checkpoint where ``rng`` is omitted."""
    if rng is None and path is not None and Path(path).exists():
        return int(str(_read(Path(path))["seed"]))
    return entropy_of(rng)
