"""The oracle's errors kept on disk: it need not run again while the estimator is worked on."""

from __future__ import annotations

from dataclasses import asdict, dataclass
import functools
import hashlib
import json
from pathlib import Path

from rs_relpose_lab.experiments import oracle, problems
from rs_relpose_lab.experiments.problems import Cell, Noise
from rs_relpose_lab.experiments.scoring import PoseError


@dataclass(frozen=True, slots=True)
class OracleCache:
    """A folder with one file per cell and kind of noise, or none.

    A file's name holds the digest of all that decides its content: the cell, the noise, and the
    source of the generator and of the oracle.
    """

    folder: Path | None

    def load(self, cell: Cell, noise: Noise) -> dict[int, PoseError]:
        """Errors of the oracle by seed."""
        path = self._path(cell, noise)
        if path is None or not path.is_file():
            return {}
        stored = json.loads(path.read_text())
        return {int(seed): PoseError(*error) for seed, error in stored.items()}

    def add(self, cell: Cell, noise: Noise, errors: dict[int, PoseError]) -> None:
        """Keep errors by seed, beside those that are kept already."""
        path = self._path(cell, noise)
        if path is None or not errors:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        merged = {**self.load(cell, noise), **errors}
        # Replaced as a whole, so that a run that is stopped leaves no half of a file.
        new = path.with_suffix('.new')
        new.write_text(json.dumps({
            seed: (error.rotation, error.translation, error.nees)
            for seed, error in sorted(merged.items())}))
        new.replace(path)

    def _path(self, cell: Cell, noise: Noise) -> Path | None:
        if self.folder is None:
            return None
        digest = hashlib.sha256(json.dumps([asdict(cell), noise]).encode() + _source())
        return self.folder / f'{digest.hexdigest()[:24]}.json'


@functools.cache
def _source() -> bytes:
    """Of the generator and the oracle, as they were when first asked for."""
    return b''.join(Path(str(module.__file__)).read_bytes() for module in (problems, oracle))
