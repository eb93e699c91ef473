import pytest
import torch

from r3dpa.bench.problems import GaussianMixture, toy_mixture
from r3dpa.flow.interpolant import Interpolant

MEANS = torch.tensor([[1.0, 0.0], [-1.0, 2.0]]).double()
MIXTURE = GaussianMixture(MEANS, 0.3, torch.tensor([1.0, 3.0]).double())
X = torch.randn(7, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def times_of(x, time):
    return torch.full((len(x),), time, dtype=torch.float64)


def test_velocity_at_both_ends_by_hand():
    torch.testing.assert_close(MIXTURE.velocity(X, times_of(X, 0.0)), -X)
    mean = torch.tensor([-0.5, 1.5]).double()
    torch.testing.assert_close(MIXTURE.velocity(X, times_of(X, 1.0)), X - mean)


@pytest.mark.parametrize("time", [0.05, 0.5, 0.95])
def test_velocity_gives_the_score_of_the_density(time):
    """Independent: the gradient of the log density, by autograd from the definition."""
    leaf = X.clone().requires_grad_()
    variance = (1 - time) ** 2 * MIXTURE.std**2 + time**2
    square = (leaf[:, None] - (1 - time) * MIXTURE.means).square().sum(2)
    log_density = torch.logsumexp(MIXTURE.weights.log() - square / (2 * variance), dim=1)
    (score,) = torch.autograd.grad(log_density.sum(), leaf)
    velocity = MIXTURE.velocity(X, times_of(X, time))
    drift = Interpolant().sde_drift(velocity, X, times_of(X, time))
    torch.testing.assert_close((velocity - drift) / time, score, rtol=1e-9, atol=1e-9)


@pytest.mark.numerics
def test_velocity_stays_finite_where_densities_underflow():
    means = torch.tensor([[100.0], [-100.0]]).double()
    far = GaussianMixture(means, 1e-4, torch.ones(2))
    x = torch.tensor([[99.0], [-99.0]]).double()
    naive = torch.exp(-(x - means.T).square() / (2 * 1e-8))
    assert (naive == 0).all()
    velocity = far.velocity(x, times_of(x, 1e-6))
    # Each point belongs wholly to the mean on its side.
    for index in range(2):
        near = GaussianMixture(means[index : index + 1], 1e-4, torch.ones(1))
        alone = near.velocity(x[index : index + 1], times_of(x[:1], 1e-6))
        torch.testing.assert_close(velocity[index : index + 1], alone)


def test_velocity_keeps_dtype_and_samples_apart():
    x = X.float()
    whole = MIXTURE.velocity(x, torch.linspace(0, 1, len(x)))
    assert whole.dtype == torch.float32
    one = MIXTURE.velocity(x[3:4], torch.linspace(0, 1, len(x))[3:4])
    torch.testing.assert_close(one, whole[3:4])


def test_toy_mixture():
    mixture = toy_mixture(1)
    assert mixture.means.shape == (128, 64)
    assert torch.linalg.matrix_rank(mixture.means) == 4
    assert torch.equal(mixture.means, toy_mixture(1).means)
    assert not torch.equal(mixture.means, toy_mixture(2).means)
