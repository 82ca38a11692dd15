"""Adam on rows: torch's own steps, gradients as they lie, and shares of a step."""

import pytest
import torch

from msgs_slam.pipelines.system.adam import AdamTable, descend, gradients_of
from tests.plain_adam import plain_descend


def test_adam_is_torchs_adam() -> None:
    start = torch.randn(20000, 3, generator=torch.Generator().manual_seed(0))
    table = AdamTable({"x": start, "unused": start})
    reference = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([reference], lr=0.01, eps=1e-15)
    for _ in range(7):
        (gradients,) = gradients_of((table.values["x"].sin() ** 2).sum(), [table.values])
        table.step(gradients, {"x": 0.01, "unused": 0.01})
        (reference.sin() ** 2).sum().backward()
        optimiser.step()
        optimiser.zero_grad()
    assert (reference - start).abs().max() > 0.01
    assert torch.allclose(table.values["x"], reference, atol=1e-6)
    assert torch.equal(table.values["unused"], start)


@pytest.mark.parametrize("shape", [(9000,), (9000, 3), (1, 5), (0, 3), (4, 0)])
@pytest.mark.parametrize("shared", [False, True])
def test_the_compiled_step_is_the_plain_one(shape: tuple[int, ...], shared: bool) -> None:
    generator = torch.Generator().manual_seed(1)
    fast = [torch.rand(shape, generator=generator) for _ in range(3)]
    plain = [x.clone() for x in fast]
    shares = torch.rand(shape[0], generator=generator) if shared else None
    for steps in (5, 6):
        gradient = torch.randn(shape, generator=generator)
        gradient[torch.rand(shape, generator=generator) < 0.3] = 0
        descend(fast[0], gradient, fast[1], fast[2], 0.1, steps, shares)
        plain_descend(plain[0], gradient, plain[1], plain[2], 0.1, steps, shares)
    for a, b in zip(fast, plain, strict=True):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-6)


def test_a_step_of_some_rows_is_that_of_all_with_no_gradient_for_the_others() -> None:
    generator = torch.Generator().manual_seed(3)
    start = {
        "x": torch.randn(300, 3, generator=generator),
        "y": torch.randn(300, generator=generator),
    }
    some, whole = AdamTable(dict(start)), AdamTable(dict(start))
    rates = {"x": 0.01, "y": 0.02}
    for _ in range(5):
        rows = torch.nonzero(torch.rand(300, generator=generator) < 0.3)[:, 0]
        gradients = {k: torch.randn(v[rows].shape, generator=generator) for k, v in start.items()}
        shares = {"x": torch.rand(len(rows), generator=generator)}
        some.step(gradients, rates, shares, rows)
        spread = {k: torch.zeros_like(v).index_copy(0, rows, gradients[k]) for k, v in start.items()}
        whole.step(spread, rates, {"x": torch.zeros(300).index_copy(0, rows, shares["x"])})
    for key, value in start.items():
        assert 0 < (some.values[key] != value).sum() < value.numel()
        assert torch.equal(some.values[key], whole.values[key])
        assert torch.equal(some.second[key], whole.second[key])


def test_what_has_no_gradient_waits() -> None:
    """Neither values nor moments go on where a view shows nothing."""
    table = AdamTable({"x": torch.zeros(2, 3)})
    table.step({"x": torch.ones(2, 3)}, {"x": 0.1})
    before = [x.detach().clone() for x in (table.values["x"], table.first["x"], table.second["x"])]
    table.step({"x": torch.tensor([[0.0] * 3, [1.0] * 3])}, {"x": 0.1})
    after = [x.detach() for x in (table.values["x"], table.first["x"], table.second["x"])]
    for old, new in zip(before, after, strict=True):
        assert torch.equal(old[0], new[0])
        assert not torch.equal(old[1], new[1])


def test_a_gradient_may_be_columns_of_a_larger_one() -> None:
    table = AdamTable({"left": torch.zeros(50, 2), "right": torch.zeros(50, 3)})
    wanted = torch.randn(50, 5, generator=torch.Generator().manual_seed(2))
    (gradients,) = gradients_of((torch.cat(list(table.values.values()), 1) * wanted).sum(), [table.values])
    right = gradients["right"]
    assert right is not None
    assert right.stride() == (5, 1), "copied: the compiled step is made for gradients that are not"
    table.step(gradients, {"left": 0.1, "right": 0.1})
    moved = torch.cat([x.detach() for x in table.values.values()], 1)
    assert torch.allclose(moved, -0.1 * wanted.sign(), rtol=1e-3)


def test_steps_by_shares() -> None:
    table = AdamTable({"x": torch.zeros(3, 2), "y": torch.zeros(3, 2)})
    gradients = dict.fromkeys("xy", torch.ones(3, 2))
    table.step(gradients, dict.fromkeys("xy", 0.1), {"x": torch.tensor([0.25, 1.0, 0.0])})
    assert torch.allclose(table.values["y"], torch.tensor(-0.1), rtol=1e-4)
    assert torch.allclose(table.values["x"], torch.tensor([[-0.025], [-0.1], [0.0]]).expand(3, 2), rtol=1e-4)


def test_values_may_be_given_in_any_order_of_memory() -> None:
    table = AdamTable({"x": torch.zeros(3, 4).T})
    table.step({"x": torch.ones(4, 3)}, {"x": 0.1})
    assert torch.allclose(table.first["x"], torch.tensor(0.1))
    assert torch.allclose(table.second["x"], torch.tensor(0.001))
