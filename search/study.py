"""The measured search: a study that many workers share, here or on other machines.

A database keeps which chains are judged, by whom, and what came out. Whatever a worker finished is
there for all others and for the next run; what it had in flight when it died is lost, and its chain
is free again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from importlib.metadata import version
from math import inf
from typing import Final, Literal, Protocol

import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, Trial, TrialState

from ..model.arch import Arch
from ..model.console import one_line
from ..model.errors import NothingFeasible, Rts2Error
from .accuracy import LOWER_IS_BETTER, Metric, Row
from .exhaustive import Question
from .exhaustive import search as search_all
from .landscape import Chains, Landscape
from .result import Found
from .sampler import REASON, ROWS, FrontSampler, as_stored
from .sources import Measured, MeasuredRows, source
from .space import Space
from .storage import opened, reached, without_password

BUDGET: Final = 200
"""Evaluations unless told."""

HEARTBEAT_S: Final = 10
"""How often a worker says that it lives."""

GRACE_S: Final = 60
"""After how long a silence a worker is taken for dead."""

POLL_S: Final = 0.2
"""How often a worker without work looks whether another was lost."""

FIRST: Final = 12
"""Chains of the analytic front that a study begins with."""

PREFIX: Final = "rts2-"
"""What the names of our studies begin with."""

WORKER: Final = "worker"
SECONDS: Final = "seconds"
RECALLED: Final = "recalled"
"""Attributes of a trial: who judges it, what that took, whether it was known from before."""


class Judge(Protocol):
    """What judges networks."""

    arch: Arch
    """The largest network that it has weights of."""
    hits: int
    """How often it knew the answer already."""

    @property
    def digest(self) -> str:
        """Of all that its figures depend on."""

    def rows(self, arch: Arch) -> tuple[Row, ...]:
        """The accuracy of a network and of all that it holds."""


@dataclass(frozen=True)
class Order:
    """What is to be studied, by how many evaluations, and where the study is kept."""

    question: Question
    judge: Callable[[], Judge]
    """Opens what judges, once in each process."""
    storage: str
    """The URL of a database."""
    metrics: tuple[Metric, ...]
    """The question's objective, and what else makes a front with the latency."""
    budget: int = BUDGET
    space: Space = field(default_factory=Space)
    heartbeat_s: int = HEARTBEAT_S
    grace_s: int = GRACE_S


@dataclass(frozen=True)
class Progress:
    """Where a study stands."""

    done: int
    failed: int
    total: int
    """How many there are to judge."""
    best: float | None
    """The best value of the first metric among networks that meet the target."""


Shown = Callable[[Progress], None]


def unseen(_progress: Progress) -> None:
    """Shows nothing."""


@dataclass(frozen=True)
class Studied:
    """What a study came to, in all its runs together."""

    rows: tuple[Row, ...]
    evaluations: int
    fresh: int
    """Evaluations of this run, other workers' among them."""
    recalled: int
    """Evaluations that were known from before: the cache on disk told them."""
    failed: tuple[str, ...]
    """Why evaluations failed."""
    seconds: float
    """What the evaluations took, all workers together."""
    workers: int
    candidates: int
    """Chains that hold a network which meets the target."""


class Work:
    """One process's part of a study."""

    def __init__(self, order: Order) -> None:
        """Opens the judge and joins the study, which is made where there is none.

        Raises:
            UsageError: a storage that cannot be opened, or a supernet that does not fit the space.
            NothingFeasible: no network meets the target.
            Rts2Error: a storage that does not answer.
        """
        self.order, self.judge = order, order.judge()
        chains = Chains.of(self.judge.arch, order.space)
        self.landscape = Landscape.of(order.question, chains, order.metrics)
        if not len(self.landscape.admitted):
            raise NothingFeasible(_none_admitted(order.question))
        first = _analytic(order.question, chains)
        self.sampler = FrontSampler(self.landscape, order.metrics, first)
        self.study, self._storage = _joined(name_of(order, self.judge.digest), order, self.sampler)
        self._nameless: dict[int, float] = {}
        """Since when running trials are known that name no worker."""

    def run(self, shown: Shown = unseen) -> None:
        """Judges one chain after another until the budget is spent or nothing is left."""
        self._free_lost()
        while not self.spent():
            shown(self.progress())
            with reached(self.order.storage):
                if self._queued():
                    self.study.optimize(self._judged, n_trials=1, catch=(Exception,))
                else:
                    optuna.storages.fail_stale_trials(self.study)
                    self._free_lost()
                    time.sleep(POLL_S)
        shown(self.progress())

    def progress(self) -> Progress:
        """Where the study stands."""
        finished = self._trials(TrialState.COMPLETE)
        metric = self.order.metrics[0]
        better = min if LOWER_IS_BETTER[metric] else max
        best = better((trial.values[1] for trial in finished), default=None)
        return Progress(len(finished), len(self._reasons()), self._total(), best)

    def studied(self, before: int) -> Studied:
        """What the study came to; so many trials were finished `before` this run.

        Raises `Rts2Error` where every evaluation failed.
        """
        finished = self._trials(TrialState.COMPLETE)
        failed = self._reasons()
        if not finished:
            raise Rts2Error(f"every evaluation failed, the first with: {failed[0]}")
        told = [trial.user_attrs for trial in finished]
        return Studied(
            rows=tuple(
                {row.arch: row for trial in finished for row in self.sampler.rows(trial)}.values()
            ),
            evaluations=len(finished),
            fresh=len(finished) - before,
            recalled=sum(each[RECALLED] for each in told),
            failed=failed,
            seconds=sum(each[SECONDS] for each in told),
            workers=len({each[WORKER] for each in told}),
            candidates=len(self.landscape.admitted),
        )

    def _trials(self, *states: TrialState) -> list[FrozenTrial]:
        with reached(self.order.storage):
            return self.study.get_trials(deepcopy=False, states=states or None)

    def _reasons(self) -> tuple[str, ...]:
        trials = self._trials(TrialState.FAIL)
        return tuple(trial.user_attrs[REASON] for trial in trials if REASON in trial.user_attrs)

    def _counting(self) -> list[FrozenTrial]:
        """The trials that spend the budget: judged, failed for a reason, running or in line."""
        return [trial for trial in self._trials() if self.sampler.taken(trial) is not None]

    def spent(self) -> bool:
        """Whether nothing is left to judge."""
        done = sum(trial.state.is_finished() for trial in self._counting())
        return done >= self._total()

    def _total(self) -> int:
        return min(self.order.budget, len(self.landscape.admitted))

    def _queued(self) -> bool:
        """Puts the next chain in line; whether there is one that a worker can take."""
        counting = self._counting()
        if any(trial.state == TrialState.WAITING for trial in counting):
            return True
        if len(counting) >= self.order.budget:
            return False
        values = self.sampler.proposed(self.study)
        if values:
            self.study.enqueue_trial(values)
        return bool(values)

    def _judged(self, trial: Trial) -> tuple[float, ...]:
        """The objectives of one chain: latency and accuracies of its best network."""
        # In this order: a trial that names its worker has a heartbeat that can fall silent.
        self._storage.record_heartbeat(trial._trial_id)
        trial.set_user_attr(WORKER, _own_name())
        values = {
            name: trial.suggest_categorical(name, axis)
            for name, axis in self.sampler.chains.axes.items()
        }
        if not self._first_of(trial.number):
            raise optuna.TrialPruned
        arch, known, started = (
            self.sampler.chains.arch(values),
            self.judge.hits,
            time.perf_counter(),
        )
        try:
            rows = self.judge.rows(arch)
            found = self._objectives(rows)
        except Exception as error:
            trial.set_user_attr(REASON, f"{arch.label()}: {one_line(error)}")
            raise
        trial.set_user_attr(SECONDS, time.perf_counter() - started)
        trial.set_user_attr(RECALLED, self.judge.hits > known)
        trial.set_user_attr(ROWS, as_stored(rows))
        trial.set_constraint("latency", found[0] / self.landscape.target_ms - 1)
        return found

    def _first_of(self, number: int) -> bool:
        """Whether no earlier trial holds the chain or the last of the budget.

        A trial is stored with its chain and gets its number in one transaction, so that of two
        workers that chose the same chain at once exactly one goes on.
        """
        counting = {trial.number: self.sampler.taken(trial) for trial in self._counting()}
        earlier = [chain for other, chain in counting.items() if other < number]
        return len(earlier) < self.order.budget and counting[number] not in earlier

    def _objectives(self, rows: Sequence[Row]) -> tuple[float, ...]:
        """Latency and metrics of the best network that meets the target."""
        metrics, found = self.order.metrics, []
        direction = 1 if LOWER_IS_BETTER[metrics[0]] else -1
        for row in rows:
            latency = self.landscape.latency_ms(row.arch)
            known = [value for metric in metrics if (value := row.value(metric)) is not None]
            if latency <= self.landscape.target_ms and len(known) == len(metrics):
                found.append((direction * known[0], latency, *known))
        if not found:
            raise Rts2Error(f"no {' and '.join(metrics)} came of it")
        return min(found)[1:]

    def _free_lost(self) -> None:
        """Frees what no heartbeat tells of: what dead workers of this machine had in flight, at
        once, and what was taken by one that died before it gave its name.
        """
        for trial in self._trials(TrialState.RUNNING):
            worker = trial.user_attrs.get(WORKER)
            since = self._nameless.setdefault(trial.number, time.monotonic())
            nameless = worker is None and time.monotonic() - since > self.order.grace_s
            if nameless or _dead(worker):
                try:
                    self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)
                except UpdateFinishedTrialError:
                    continue  # another worker was faster


def _none_admitted(question: Question) -> str:
    """Why no chain is worth judging."""
    limits = {
        "--max-size-mb": question.max_size_bytes < inf,
        "--min-depth": question.min_disparity > 0,
        "--precision": bool(question.precisions),
        "--runtime": bool(question.runtimes),
    }
    asked = [option for option, given in limits.items() if given]
    within = f" within {' and '.join(asked)}" if asked else ""
    return (
        f"no network that the supernet holds meets {question.target_fps:g} FPS on "
        f"{question.profile.title}{within}, and none was judged; lower the target"
        + (" or ask for less" if asked else "")
    )


def run(order: Order, workers: int = 1, shown: Shown = unseen) -> Studied:
    """Runs the study with so many workers on this machine, until its budget is spent.

    Raises as `Work` does, and `Rts2Error` where every evaluation failed.
    """
    own = Work(order)
    before = own.progress().done
    with _beside(order, 0 if own.spent() else workers - 1):
        own.run(shown)
    return own.studied(before)


def source_of(studied: Studied) -> Measured:
    """What the study judged, as a source of accuracy."""
    return Measured(MeasuredRows(schema="rts2.accuracy/1", rows=studied.rows))


def found_by(order: Order, studied: Studied) -> Found:
    """The exact front over everything that the study judged."""
    return search_all(order.question, source_of(studied))


def name_of(order: Order, digest: str) -> str:
    """The study's name: of all that its answers depend on, the budget not among them."""
    question = {
        each.name: str(getattr(order.question, each.name))
        for each in fields(order.question)
        if each.name != "profile"
    }
    told = {
        "judge": digest,
        "profile": order.question.profile.model_dump(mode="json", by_alias=True),
        "question": question,
        "metrics": order.metrics,
        "space": str(order.space),
        "version": version("rts2"),
    }
    return PREFIX + hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


@contextmanager
def _beside(order: Order, count: int) -> Iterator[None]:
    """Runs the same study in so many further processes; they end when it does."""
    from multiprocessing import get_context

    context = get_context("spawn")
    others = [context.Process(target=_work, args=(order,), daemon=True) for _ in range(count)]
    for other in others:
        other.start()
    try:
        yield
        for other in others:
            other.join()
    finally:
        for other in others:
            other.kill()


def _work(order: Order) -> None:
    """What a further process does; a fault of the study, the first process meets too."""
    try:
        Work(order).run()
    except Exception as error:
        logging.getLogger(__name__).warning("a worker ended: %s", one_line(error))


def _analytic(question: Question, chains: Chains) -> list[int]:
    """Chains of the front that the paper's tables give, a few from end to end."""
    front = search_all(question, source("published")).front
    meeting = [point.arch for point in front if point.fps >= question.target_fps]
    numbers = list(dict.fromkeys(chains.nearest(arch) for arch in meeting))
    places = {round(k * (len(numbers) - 1) / (FIRST - 1)) for k in range(FIRST)}
    return [numbers[place] for place in sorted(places)] if numbers else []


def _joined(name: str, order: Order, sampler: FrontSampler) -> tuple[optuna.Study, RDBStorage]:
    """The study, and the database that keeps it."""
    accuracies: list[Literal["minimize", "maximize"]] = [
        "minimize" if LOWER_IS_BETTER[m] else "maximize" for m in order.metrics
    ]
    optuna.logging.set_verbosity(optuna.logging.CRITICAL)
    with reached(order.storage):
        storage = opened(order.storage, order.heartbeat_s, order.grace_s)
        others = {summary.study_name for summary in optuna.get_all_study_summaries(storage)}
        if name not in others and any(other.startswith(PREFIX) for other in others):
            text = "note: %s holds studies of another supernet, data, device or question; "
            text += "this one begins anew beside them"
            logging.getLogger(__name__).warning(text, without_password(order.storage))
        study = optuna.create_study(
            study_name=name,
            storage=storage,
            sampler=sampler,
            directions=["minimize", *accuracies],
            load_if_exists=True,
        )
    return study, storage


def _own_name() -> str:
    return f"{socket.gethostname()}:{os.getpid()}"


def _dead(worker: str | None) -> bool:
    """Whether a worker was of this machine and its process is gone."""
    host, _, process = (worker or "").rpartition(":")
    if host != socket.gethostname():
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False  # it lives, as another user's
    return False
