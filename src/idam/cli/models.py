"""``idam models``."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["models"]

USES = {
    "general": "scans of any kind, in any pose: what 'idam register' uses unless told otherwise",
    "practice-any-rotation": "sparse, noisy clouds of single objects, in any pose",
    "gnn-practice": "sparse, noisy clouds of single objects that stand upright, with --max-angle 90",
    "gnn-gaussian-noise": "the paper's experiment; symmetric objects that stand upright, with --max-angle 90",
}
"""What to choose a model for; all others are for the paper's experiments."""


def models(
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Also print the commands that trained them.")
    ] = False,
) -> None:
    """List the shipped models: what each is for, what it was trained on, and its validation errors."""
    from idam.weights import DEFAULT, list_models, provenance

    names = sorted(list_models(), key=lambda name: (name != DEFAULT, name not in USES, name))
    for name in names:  # no table: names and commands are to be copied, whatever the terminal's width
        history = provenance(name)
        config = history["config"]
        print(f"{name}  (the default)" if name == DEFAULT else name)
        inference = " with the paper's inference" if name.endswith("-paper") else ""
        print(f"  for {USES.get(name, 'the experiment of the paper' + inference)}")
        print(
            f"  {config['features']} features, {history.get('experiment', '')}, {config['iterations']} iterations, "
            f"{history.get('steps', '')} steps, seed {history.get('recipe', {}).get('seed', '')}, "
            f"commit {history.get('commit') or 'unknown'}"
        )
        print(f"  {as_told(history.get('validation', {}))}")
        if verbose:
            print(f"  {history.get('command', '')}")
    print("RMSE and MAE in degrees, network alone; accuracy: share of points whose best match is right.")
    print("All on shapes held out of the training.")
    print("Names that begin with gnn or fpfh are networks of the paper and need PyTorch: pip install 'idam[torch]'.")
    print("Give one alone, or after a descriptor, as in practice-any-rotation+gnn-practice.")


def as_told(scores: dict[str, float]) -> str:
    """The validation on one line: errors of the registration, or the accuracy of the matches."""
    if "accuracy" in scores:
        return f"accuracy {scores['accuracy']:.3f}, matching loss {scores.get('matching', float('nan')):.3f}"
    return f"RMSE(R) {scores.get('rmse_r', float('nan')):.3f}, MAE(R) {scores.get('mae_r', float('nan')):.3f}"
