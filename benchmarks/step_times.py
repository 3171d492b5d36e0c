"""What a step of two trainers takes, in turns (`torch_radiance.py --turns`)."""

from __future__ import annotations

from timing import in_turns, median, spread


def take_turns(ours, peer, turns: int, steps: int = 8, before: int = 100) -> None:
    """Print what a step of each takes, in ``turns`` of ``steps``, after ``before`` that clear the first fog."""

    def some(trainer, count: int) -> None:
        for _ in range(count):
            trainer.step()

    works = {"nerg_mi": lambda: some(ours, steps), "PyTorch": lambda: some(peer, steps)}
    for trainer in (ours, peer):
        some(trainer, before)
    taken = in_turns(works, turns)
    for name, times in taken.items():
        wall, cpu = (median(t) / steps for t in zip(*times))
        print(
            f"{name}: {1e3 * cpu:.1f} ms of CPU a step ({1e3 * wall:.1f} ms; {spread(c / steps for _, c in times)} s)"
        )
    ratios = [median(t[k] for t in taken["PyTorch"]) / median(t[k] for t in taken["nerg_mi"]) for k in (1, 0)]
    print(f"PyTorch takes {ratios[0]:.1f} times our CPU, {ratios[1]:.1f} times our time")
