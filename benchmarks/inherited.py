"""Whether accuracies inherited from a supernet order networks as training each alone does.

    python benchmarks/inherited.py SUPERNET ALONE… [--size 320x160] [--count 100] [--json]

ALONE are checkpoints of networks that the supernet holds, each trained by itself on one schedule.
Both are judged on the same generated scenes. Kendall's tau is over the whole networks, and over
those of fewer stages too; within a network, more stages should be better, as the paper has it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import mkdtemp

from scipy.stats import kendalltau

from rts2.model.arch import Arch
from rts2.model.box import named_model
from rts2.model.checkpoint import load
from rts2.model.console import resolution
from rts2.model.data.catalog import open_dataset
from rts2.model.evaluation import evaluate, overall
from rts2.model.predictor import TorchPredictor
from rts2.search.inherited import BATCH, BATCHES, Data, Inherited

Found = dict[int, tuple[float, float]]
"""D1-all by stages: trained alone, and inherited."""


def main() -> None:
    """The table, or its figures as JSON."""
    options = _options()
    if not options.alone:
        print("{}" if options.json else "nothing to compare: give networks trained alone")
        return
    judging = open_dataset("streets", split="val", count=options.count, size=options.size)
    training = open_dataset("streets", split="train", count=BATCH * BATCHES, size=options.size)
    data = Data.of(training, judging, options.count)
    judge = Inherited(named_model(options.supernet), data, options.out)
    _orders(judge, data, options)


def _orders(judge: Inherited, data: Data, options: argparse.Namespace) -> None:
    """Judges every network twice, and tells how alike the two orders are."""
    found = {}
    for path in options.alone:
        network, _ = load(path)
        judged = [each.scores for each in evaluate(TorchPredictor(network), data.judging)]
        alone = {stage: score.d1_all for stage, score in overall(judged).items()}
        rows = {r.arch.stages: r.d1_all for r in judge.rows(network.arch) if r.arch.refinement}
        found[network.arch] = {stage: (alone[stage], rows[stage]) for stage in rows}
    whole = tau([found[arch][arch.stages] for arch in found])
    every = tau([pair for each in found.values() for pair in each.values()])
    stages = ordered(list(found.values()))
    if options.json:
        told = {"kendall_tau": whole, "kendall_tau_stages": every, "stages_in_order": stages}
        print(json.dumps(told))
        return
    show(found, data)
    print(f"Kendall's tau {whole:.3f} over {len(found)} networks, {every:.3f} with fewer stages")
    print(f"{stages:.0%} of inherited accuracies improve from stage to stage")


def tau(pairs: Sequence[tuple[float, float]]) -> float:
    """Kendall's tau-b of the two orders."""
    alone, inherited = zip(*pairs, strict=True)
    return float(kendalltau(alone, inherited).statistic)


def ordered(found: Sequence[Found]) -> float:
    """The share of steps from one stage to the next at which the inherited D1-all falls."""
    steps = [
        later[1] < before[1]
        for each in found
        for before, later in pairwise(each[stage] for stage in sorted(each))
    ]
    return sum(steps) / len(steps)


def show(found: dict[Arch, Found], data: Data) -> None:
    """The table, the most accurate network first."""
    print(f"D1-all % after stages 1, 2, 3 on {len(data.judging)} scenes: alone | inherited")
    for arch, each in sorted(found.items(), key=lambda item: item[1][item[0].stages]):
        widths = "/".join(map(str, arch.conv3d))
        columns = (" ".join(f"{each[stage][side]:6.2f}" for stage in each) for side in (0, 1))
        print(f"  c={arch.c:<3} d_max={arch.d_max:<3} {widths:9}" + "  | ".join(columns))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("supernet", nargs="?", default="supernet")
    parser.add_argument("alone", nargs="*", type=Path)
    parser.add_argument("--size", type=resolution, default=(320, 160))
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    options.out = options.out or Path(mkdtemp(prefix="rts2."))
    return options


if __name__ == "__main__":
    main()
