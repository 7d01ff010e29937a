"""Workers killed at random moments, on a real PostgreSQL server."""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from rts2.search.storage import sqlite
from rts2.search.study import Order, Work, found_by, run

from .standin import MEDIUM, StandIn, order

KILLS = 20
BUDGET = 48
"""Every chain of the stand-in's space: how a study gets there cannot change its front."""

SCRIPT = Path(__file__).with_name("standin.py")


def _program(name: str) -> str:
    for folder in (os.environ["PATH"], *map(str, Path("/usr/lib/postgresql").glob("*/bin"))):
        if found := shutil.which(name, path=folder):
            return found
    pytest.skip(f"{name} is not installed: no PostgreSQL server to share a study through")


@pytest.fixture
def server() -> Iterator[str]:
    """The URL of a server of this test's own, which refuses to run as root."""
    pytest.importorskip("psycopg2")
    programs = [_program(name) for name in ("initdb", "pg_ctl")]
    with tempfile.TemporaryDirectory(prefix="rts2-pg.") as name:
        folder = Path(name)
        own = ["runuser", "-u", "nobody", "--"] if os.geteuid() == 0 else []
        if own:
            shutil.chown(folder, "nobody")

        def call(*command: str) -> None:
            subprocess.run(
                [*own, *command], check=True, cwd=folder, stdout=subprocess.DEVNULL, timeout=60
            )

        data = str(folder / "data")
        call(programs[0], "--auth=trust", "--username=study", "--no-sync", "-D", data)
        options = f"-k {folder} -c listen_addresses= -c fsync=off"
        call(programs[1], "-w", "-D", data, "-l", str(folder / "log"), "-o", options, "start")
        try:
            yield f"postgresql://study@/postgres?host={folder}"
        finally:
            call(programs[1], "-D", data, "-m", "immediate", "stop")


def _started(*arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, str(SCRIPT), *arguments], start_new_session=True, stderr=subprocess.PIPE
    )


def test_twenty_killed_workers_lose_nothing_that_was_finished(server: str, tmp_path: Path) -> None:
    """Each is killed a random moment after an evaluation began; the same command goes on."""
    written = tmp_path / "journal"
    chance = random.Random(11)
    asked = order(server, StandIn(), BUDGET, MEDIUM)
    known: set[str] = set()
    for _ in range(KILLS):
        worker = _started(server, str(written), str(BUDGET), "1")
        _wait_for_one(asked, worker)
        time.sleep(chance.uniform(0, 0.25))
        assert worker.poll() is None
        os.killpg(worker.pid, signal.SIGKILL)
        worker.communicate()
        finished = _finished(asked)
        assert known <= finished
        known = finished
    assert len(known) < BUDGET
    last = _started(server, str(written), str(BUDGET), "2")
    try:
        last.wait(timeout=60)
    finally:
        if last.poll() is None:
            os.killpg(last.pid, signal.SIGKILL)
        errors = last.communicate()[1].decode()
    assert last.returncode == 0, errors
    assert len(_finished(asked)) == BUDGET
    counted = Counter(written.read_text().splitlines())
    assert len(counted) == BUDGET
    # A chain is written down as its evaluation ends, a moment before the database has it: one
    # that is there twice was killed in between, and never one that was finished.
    lost = [trial for trial in Work(asked).study.get_trials() if trial.state.name == "FAIL"]
    assert KILLS // 2 <= len(lost) <= KILLS
    assert counted.total() <= BUDGET + len(lost)
    quiet = order(sqlite(tmp_path / "quiet.db"), StandIn(), BUDGET, MEDIUM)
    again = run(asked)
    assert again.fresh == 0
    assert found_by(asked, again).front == found_by(quiet, run(quiet)).front


def _finished(asked: Order) -> set[str]:
    """The numbers and chains of finished trials, as text."""
    study = Work(asked).study
    return {
        f"{trial.number} {trial.params} {trial.user_attrs['rows']}"
        for trial in study.get_trials()
        if trial.state.name == "COMPLETE"
    }


def _wait_for_one(asked: Order, worker: subprocess.Popen[bytes]) -> None:
    """Until the worker has an evaluation in flight, or has ended."""
    work = Work(asked)
    mine = f":{worker.pid}"
    deadline = time.monotonic() + 30
    while worker.poll() is None and time.monotonic() < deadline:
        trials = work.study.get_trials(deepcopy=False)
        if any(t.user_attrs.get("worker", "").endswith(mine) for t in trials):
            return
        time.sleep(0.02)
