"""What the tests of the rivals share."""

from networks import (  # noqa: F401 - what is imported here is a fixture of every test beside
    _same_weights_every_time,
    assert_rotations,
    close,
    dtype,
    generator,
    linear_norm_relu,
    one_thread,
    rand,
    randn,
    same_gradients,
    seasoned,
)
