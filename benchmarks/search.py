"""Where the time of rts2-search goes, and how far it is from predicting networks one by one."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter

RUNS = 5
COMMAND = ["--device", "tx2", "--target-fps", "10", "--json", "--out"]


def command_s() -> float:
    """The whole command in a fresh process, with picture and files."""
    code = "import sys; from rts2.search.cli import search; sys.exit(search(sys.argv[1:]))"
    with tempfile.TemporaryDirectory() as folder:
        started = perf_counter()
        subprocess.run(
            [sys.executable, "-c", code, *COMMAND, folder], check=True, stdout=subprocess.DEVNULL
        )
        return perf_counter() - started


def in_process_s() -> tuple[float, float, int]:
    """The search alone and its picture alone, imports excluded; and how many candidates."""
    from rts2.profiles.profile import load
    from rts2.search.exhaustive import Question, search
    from rts2.search.plot import save
    from rts2.search.sources import source

    question, known = Question(load("tx2"), 10.0), source("published")
    search(question, known)
    started = perf_counter()
    found = search(question, known)
    searched = perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        save(found, "Jetson TX2", Path(folder) / "front.png")
    return searched - started, perf_counter() - searched, found.space.size


def one_by_one_s(count: int = 300) -> float:
    """Predicting a candidate alone, on average."""
    from rts2.model.arch import Arch
    from rts2.profiles.latency import predict_ms
    from rts2.profiles.profile import load

    model = load("tx2").calibrations[0].model
    started = perf_counter()
    for index in range(count):
        predict_ms(model, Arch(c=1 + index % 32), (1242, 375))
    return (perf_counter() - started) / count


def main() -> None:
    """Measures and prints the table, or its ratios as JSON."""
    whole = median(command_s() for _ in range(RUNS))
    searches, pictures, sizes = zip(*(in_process_s() for _ in range(RUNS)), strict=True)
    search, picture, size = median(searches), median(pictures), sizes[0]
    ratios = {
        "exhaustive_vs_one_by_one": one_by_one_s() * size / search,
        "search_share": search / whole,
        "picture_share": picture / whole,
        "start_share": 1 - (search + picture) / whole,
    }
    if "--json" in sys.argv:
        print(json.dumps(ratios))
        return
    print(f"rts2-search, {size:,} candidates, median of {RUNS} runs")
    print(f"  whole command   {whole:7.2f} s")
    print(f"  the search      {search:7.2f} s   {ratios['search_share']:6.1%}")
    print(f"  the picture     {picture:7.2f} s   {ratios['picture_share']:6.1%}")
    print(f"  start, files    {whole - search - picture:7.2f} s   {ratios['start_share']:6.1%}")
    print(f"  against one by one: {ratios['exhaustive_vs_one_by_one']:,.0f} × faster")


if __name__ == "__main__":
    main()
