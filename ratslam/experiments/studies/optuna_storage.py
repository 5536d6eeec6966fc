"""Optuna's record of a tuning, in one file that a kill leaves whole.

What is chosen follows from the sampler's seed, the trial's number and what was known when its batch began: a
tuning that was killed goes on as if it had not been.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from ratslam.experiments.studies.schema import Parameter, TunePlan
from tactile.base.errors import InputError
from tactile.base.random_streams import stream

JOURNAL = "journal.log"
"""The file's name."""


class Trial(NamedTuple):
    """A set of parameters that was tried.

    Attributes:
        parameters: by key path. values: of the objectives; None where a run failed or has no such value.
        optimal: whether no other is as good in all objectives and better in one.
    """

    number: int
    parameters: dict[str, Any]
    values: dict[str, float] | None
    optimal: bool


class Journal:
    """A tuning's record; make one with `opened`.

    Args:
        book: Optuna's study.
    """

    def __init__(self, book: Any, plan: TunePlan) -> None:
        self._book, self._plan = book, plan

    def ask(self, numbers: Sequence[int]) -> dict[int, dict[str, Any]]:
        """Parameters for those trials of a batch whose values are not known yet, by number."""
        known = {trial.number: trial for trial in self._book.get_trials(deepcopy=False)}
        finished = {number for number, trial in known.items() if trial.state.is_finished()}
        return {
            number: self._parameters(number, known.get(number))
            for number in numbers
            if number not in finished
        }

    def tell(self, number: int, values: Sequence[float] | None) -> None:
        """What the objectives of a trial came to; None: it failed."""
        from optuna.trial import TrialState

        if values is None:
            self._book.tell(number, state=TrialState.FAIL)
        else:
            self._book.tell(number, list(values))

    def trials(self) -> list[Trial]:
        """All of them, in order."""
        names, found = list(self._plan.directions()), self._book.get_trials(deepcopy=False)
        best = {trial.number for trial in self._book.best_trials} if any(t.values for t in found) else set()
        return [
            Trial(
                number=trial.number,
                parameters=dict(trial.params),
                values=dict(zip(names, trial.values, strict=True)) if trial.values else None,
                optimal=trial.number in best,
            )
            for trial in found
        ]

    def _parameters(self, number: int, begun: Any) -> dict[str, Any]:
        """Chosen now, or, of a trial that a killed process had begun, as far as it had not."""
        import optuna

        self._book.sampler = _sampler(self._plan, f"tune.{number}")
        trial = self._book.ask() if begun is None else optuna.trial.Trial(self._book, begun._trial_id)
        chosen = {}
        for key, found in self._plan.parameters.items():
            self._book.sampler = _sampler(self._plan, f"tune.{number}.{key}")
            chosen[key] = _suggested(trial, key, found)
        return chosen


@contextmanager
def opened(directory: Path, name: str, plan: TunePlan) -> Iterator[Journal]:
    """The record of a tuning in a directory, taken up where an earlier process left it.

    Args:
        name: of all whose trials can be compared; another name begins anew.

    Raises:
        InputError: Optuna is missing, or another tuning is at work in the directory.
    """
    try:
        import optuna
        from optuna.storages.journal import JournalFileBackend
    except ImportError:
        cure = "pip install 'ratslam[sweep]'"
        raise InputError("--tune", "Optuna is not installed", "the extra 'sweep'", cure) from None
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    path = directory / JOURNAL
    try:
        with _alone(directory / f".{JOURNAL}.lock"):
            _mend(path)
            lock: Any = _Unlocked()
            backend = JournalFileBackend(str(path), lock_obj=lock)
            book = optuna.create_study(
                storage=optuna.storages.JournalStorage(backend),
                study_name=name,
                directions=list(plan.directions().values()),
                load_if_exists=True,
            )
            yield Journal(book, plan)
    finally:
        optuna.logging.set_verbosity(verbosity)


class _Unlocked:
    """Optuna's own lock is a file, which a killed process leaves behind; `_alone` stands in its place."""

    def acquire(self) -> bool:
        return True

    def release(self) -> None:
        pass


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Holds a lock that the operating system takes back when this process ends, however it does."""
    import fcntl

    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            found = "another tuning is at work there"
            raise InputError(
                str(path.parent), found, "one at a time", "choose another folder with -o"
            ) from None
        yield


def _mend(path: Path) -> None:
    """Cuts off a last line that was not written whole."""
    if path.exists() and not (content := path.read_bytes()).endswith(b"\n"):
        with path.open("r+b") as file:
            file.truncate(content.rfind(b"\n") + 1)


def _sampler(plan: TunePlan, name: str) -> Any:
    """With a stream of its own: it is no matter what this process has drawn before."""
    import optuna

    seed = int(stream(plan.seed, name).integers(2**31))
    if plan.sampler == "nsga2":
        return optuna.samplers.NSGAIISampler(seed=seed, population_size=plan.population)
    return optuna.samplers.TPESampler(seed=seed)


def _suggested(trial: Any, key: str, found: Parameter) -> Any:
    if found.choices is not None:
        return trial.suggest_categorical(key, found.choices)
    suggest = trial.suggest_int if found.whole else trial.suggest_float
    return suggest(key, found.low, found.high, log=found.log)
