"""Weight decay on dead channels ends in zeros, and leaves what learns to the bit."""

import torch
from torch import Tensor, nn

from idam.lab.training.underflow import flush_to_zero


def trained(flush: bool, steps: int) -> tuple[nn.Linear, torch.optim.Adam]:
    """A linear map whose second output plays no part in the loss."""
    torch.manual_seed(0)
    layer, x = nn.Linear(6, 2), torch.randn(20, 6)
    optimizer = torch.optim.Adam(layer.parameters(), lr=0.05, weight_decay=1e-3)
    if flush:
        flush_to_zero(optimizer)
    for _ in range(steps):
        optimizer.zero_grad()
        (layer(x)[:, 0] - x.sum(1)).square().mean().backward()
        optimizer.step()
    return layer, optimizer


def small(values: Tensor, smallest: float) -> bool:
    return bool(((values != 0) & (values.abs() < smallest)).any())


def test_dead_channels_end_in_zeros_and_the_others_as_without() -> None:
    (plain, unwatched), (layer, optimizer) = trained(False, 1500), trained(True, 1500)
    assert small(plain.weight, 1e-12)
    assert not small(layer.weight, 1e-12)
    assert torch.equal(layer.weight[0], plain.weight[0])
    tiny = torch.finfo(torch.float32).tiny
    moments = [
        [state[key] for state in x.state.values() for key in ("exp_avg", "exp_avg_sq")] for x in (unwatched, optimizer)
    ]
    assert any(small(x, tiny) for x in moments[0])
    assert not any(small(x, tiny) for x in moments[1])
