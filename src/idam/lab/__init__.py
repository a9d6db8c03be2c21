"""What ``pip install idam`` never runs: data, training, evaluation and figures of the paper."""
