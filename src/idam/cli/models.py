"""``idam models``."""

from __future__ import annotations

__all__ = ["models"]


def models() -> None:
    """List the shipped models: what they were trained on and how they did."""
    from idam.weights import list_models, provenance

    for name in list_models():  # no table: names and commands are to be copied, whatever the terminal's width
        history = provenance(name)
        config = history["config"]
        print(name)
        print(
            f"  {config['features']} features, {history.get('experiment', '')}, {config['iterations']} iterations, "
            f"{history.get('steps', '')} steps, seed {history.get('recipe', {}).get('seed', '')}, "
            f"commit {history.get('commit') or 'unknown'}"
        )
        print(f"  {as_told(history.get('validation', {}))}")
        print(f"  {history.get('command', '')}")
    print("RMSE and MAE in degrees, network alone; accuracy: share of points whose best match is right.")
    print("All on shapes held out of the training.")


def as_told(scores: dict[str, float]) -> str:
    """What a validation found, on a line: the errors of a registration, or how well features match."""
    if "accuracy" in scores:
        return f"accuracy {scores['accuracy']:.3f}, matching loss {scores.get('matching', float('nan')):.3f}"
    return f"RMSE(R) {scores.get('rmse_r', float('nan')):.3f}, MAE(R) {scores.get('mae_r', float('nan')):.3f}"
