"""A study in a database: what many workers share, what is lost with one, what is refused."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from rts2.model.errors import NothingFeasible, Rts2Error, UsageError
from rts2.search.exhaustive import search
from rts2.search.sources import Measured, MeasuredRows
from rts2.search.space import Space
from rts2.search.storage import reached, sqlite, without_password
from rts2.search.study import Order, Progress, Studied, Work, found_by, name_of, run

from .standin import SMALL, StandIn, held, order, standin_row

CHAINS = 16


def journal(path: Path) -> Counter[str]:
    return Counter(path.read_text().splitlines())


def trials(asked: Order) -> list[optuna.trial.FrozenTrial]:
    return Work(asked).study.get_trials()


@pytest.fixture
def url(tmp_path: Path) -> str:
    return sqlite(tmp_path / "study.db")


def test_every_chain_is_judged_once_and_the_front_is_that_of_their_table(
    url: str, tmp_path: Path
) -> None:
    asked = order(url, StandIn(tmp_path / "journal"))
    shown: list[Progress] = []
    found = run(asked, shown=shown.append)
    assert (found.evaluations, found.fresh, found.candidates, found.failed) == (16, 16, 16, ())
    assert journal(tmp_path / "journal").total() == len(journal(tmp_path / "journal")) == CHAINS
    chains = Work(asked).sampler.chains
    rows = {
        part: standin_row(part)
        for number in range(CHAINS)
        for part in held(chains.arch(chains.values(number)))
    }
    assert {row.arch: row for row in found.rows} == rows
    table = MeasuredRows(schema="rts2.accuracy/1", rows=tuple(rows.values()))
    exact = search(asked.question, Measured(table))
    assert found_by(asked, found).front == exact.front
    assert [at.done for at in shown] == list(range(CHAINS + 1))
    assert exact.selected is not None
    assert shown[-1].best == exact.selected.d1_all


def test_the_same_command_again_judges_nothing(url: str, tmp_path: Path) -> None:
    asked = order(url, StandIn(tmp_path / "journal"), budget=5)
    first, again = run(asked), run(asked)
    assert journal(tmp_path / "journal").total() == 5
    assert (again.evaluations, again.fresh, again.rows) == (5, 0, first.rows)
    longer = run(replace(asked, budget=7))
    assert (longer.evaluations, longer.fresh) == (7, 2)


def test_two_workers_share_a_study_and_repeat_nothing(url: str, tmp_path: Path) -> None:
    found = run(order(url, StandIn(tmp_path / "journal", 0.3), budget=9), workers=2)
    counted = journal(tmp_path / "journal")
    assert counted.total() == len(counted) == found.evaluations == 9


def test_of_two_that_hold_one_chain_the_first_goes_on(url: str, tmp_path: Path) -> None:
    """As when two workers choose at the same moment."""
    asked = order(url, StandIn(tmp_path / "journal"), budget=3)
    study = Work(asked).study
    for _ in range(2):
        study.enqueue_trial({"c": 4, "d_max": 6, "conv3d_1": 16, "conv3d_2": 4, "conv3d_3": 2})
    run(asked)
    counted = journal(tmp_path / "journal")
    assert counted["4 6 (16, 4, 2)"] == 1
    assert counted.total() == 3
    states = [trial.state for trial in trials(asked)]
    assert states[:2] == [TrialState.COMPLETE, TrialState.PRUNED]


def test_what_a_dead_worker_of_this_machine_had_in_flight_is_free_at_once(
    url: str, tmp_path: Path
) -> None:
    """The run ends as an undisturbed one does, chain for chain."""
    quiet = order(sqlite(tmp_path / "quiet.db"), StandIn(tmp_path / "quiet"), budget=8)
    run(quiet)
    asked = order(url, StandIn(tmp_path / "journal"), budget=8)
    run(replace(asked, budget=4))
    work = Work(asked)
    host = trials(asked)[0].user_attrs["worker"].rpartition(":")[0]
    work.study.add_trial(
        optuna.trial.create_trial(
            state=TrialState.RUNNING,
            params=work.sampler.proposed(work.study),
            distributions=work.sampler.dimensions(),
            user_attrs={"worker": f"{host}:{2**22 + 1}"},  # beyond every process number
        )
    )
    found = run(asked)
    assert found.evaluations == 8
    assert (tmp_path / "journal").read_text() == (tmp_path / "quiet").read_text()


def test_what_was_taken_by_one_that_died_before_it_gave_its_name_is_freed(url: str) -> None:
    """No heartbeat was ever recorded for it, so that none can fall silent."""
    asked = order(url, StandIn(), grace_s=1)
    work = Work(asked)
    values, axes = work.sampler.proposed(work.study), work.sampler.dimensions()
    work.study.add_trial(
        optuna.trial.create_trial(state=TrialState.RUNNING, params=values, distributions=axes)
    )
    assert run(asked).evaluations == CHAINS
    assert trials(asked)[0].state == TrialState.FAIL


def test_a_failed_evaluation_is_told_and_the_search_goes_on(url: str) -> None:
    asked = order(url, StandIn(broken=(2,)))
    found = run(asked)
    assert (found.evaluations, len(found.failed)) == (12, 4)
    assert found.failed[0] == "c=2, 3 stages, full: nothing at c=2"
    assert run(asked).fresh == 0
    with pytest.raises(Rts2Error, match="every evaluation failed, the first with: c="):
        run(order(url, StandIn(broken=SMALL.c, digest="all broken")))


def test_without_a_network_that_meets_the_target_nothing_is_judged(
    url: str, tmp_path: Path
) -> None:
    with pytest.raises(NothingFeasible, match="holds meets 100000 FPS on Jetson TX2"):
        run(order(url, StandIn(tmp_path / "journal"), target_fps=1e5))
    assert not (tmp_path / "journal").exists()


def test_another_supernet_question_or_space_has_a_study_of_its_own(
    url: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    asked = order(url, StandIn(tmp_path / "journal"), budget=2)
    others = [
        replace(asked, question=replace(asked.question, target_fps=2.0)),
        replace(asked, question=replace(asked.question, objective="epe")),
        replace(asked, metrics=("d1_all",)),
        replace(asked, space=Space(c=(1, 2))),
    ]
    names = {name_of(each, "made up") for each in (asked, *others)} | {name_of(asked, "other")}
    assert len(names) == 6
    assert name_of(replace(asked, budget=9, heartbeat_s=3), "made up") == name_of(asked, "made up")
    run(asked)
    assert caplog.text == ""
    again: Studied = run(order(url, StandIn(tmp_path / "journal", digest="other"), budget=2))
    assert again.fresh == 2
    assert "holds studies of another supernet, data, device or question" in caplog.text


@pytest.mark.parametrize(
    ("url", "kind", "told"),
    [
        ("study", UsageError, "must be a database's URL, such as sqlite:///study.db or"),
        ("strange://x", UsageError, "must be a database's URL"),
        ("sqlite:////no/such/folder/a.db", Rts2Error, "does not answer .unable to open"),
        ("postgresql://me:secret@127.0.0.1:1/a", Rts2Error, "does not answer .connection to"),
    ],
)
def test_a_storage_that_is_none_is_refused_in_one_line(
    url: str, kind: type[Rts2Error], told: str
) -> None:
    if url.startswith("postgresql"):
        pytest.importorskip("psycopg2")
    with pytest.raises(kind, match=told) as caught:
        run(order(url, StandIn()))
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)


def test_a_missing_driver_is_named() -> None:
    refused = pytest.raises(UsageError, match=r"pip install 'rts2\[postgresql\]'")
    with refused, reached("postgresql://here/study"):
        raise ImportError("No module named 'psycopg2'")
    assert without_password("postgresql://me:secret@here/s") == "postgresql://me:***@here/s"
