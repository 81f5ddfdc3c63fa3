"""The DPVO network: feature encoders and the recurrent update, with the official checkpoint's names.

Written from its published description; 3,384,324 parameters. Shapes: E edges, M patches, images [1, 3, H, W].
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from sf_interfaces.errors import ConfigError

DIM = 384  # of the hidden state and the context
FEATURES = 128  # of matching
PATCH = 3  # px, side of a patch at quarter resolution
RADIUS = 3  # of the correlation window, px at each level
LEVELS = (1, 4)  # pooling of the target's features
_CORRELATIONS = len(LEVELS) * (2 * RADIUS + 1) ** 2 * PATCH**2
_EPS = 1e-3  # of layer normalisation


class _Residual(nn.Module):
    """Two 3x3 convolutions beside an identity, halved in size where ``stride`` is 2."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1)
        self.norm = nn.InstanceNorm2d(outputs) if norm else nn.Identity()
        self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride), self.norm) if stride > 1 else None

    def forward(self, x: Tensor) -> Tensor:
        y = functional.relu(self.norm(self.conv1(x)))
        y = functional.relu(self.norm(self.conv2(y)))
        return functional.relu((x if self.downsample is None else self.downsample(x)) + y)


class Encoder(nn.Module):
    """Features at quarter resolution, [1, outputs, H/4, W/4]."""

    def __init__(self, outputs: int, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 32, 7, 2, 3)
        self.norm = nn.InstanceNorm2d(32) if norm else nn.Identity()
        self.layer1 = nn.Sequential(_Residual(32, 32, 1, norm), _Residual(32, 32, 1, norm))
        self.layer2 = nn.Sequential(_Residual(32, 64, 2, norm), _Residual(64, 64, 1, norm))
        self.conv2 = nn.Conv2d(64, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv2(self.layer2(self.layer1(functional.relu(self.norm(self.conv1(x))))))


class _SoftAggregation(nn.Module):
    """A softmax-weighted sum over the edges of each group, given back to all of them."""

    def __init__(self) -> None:
        super().__init__()
        self.f, self.g, self.h = nn.Linear(DIM, DIM), nn.Linear(DIM, DIM), nn.Linear(DIM, DIM)

    def forward(self, x: Tensor, group: Tensor) -> Tensor:
        _, index = torch.unique(group, return_inverse=True)
        count, where = int(index.max()) + 1, index[:, None].expand(-1, DIM)
        logits = self.g(x)
        top = torch.full((count, DIM), -torch.inf, dtype=x.dtype).scatter_reduce(0, where, logits, "amax")
        share = torch.exp(logits - top[index])
        total = torch.zeros(count, DIM, dtype=x.dtype).index_add(0, index, share)
        mean = torch.zeros(count, DIM, dtype=x.dtype).index_add(0, index, self.f(x) * share) / total
        return self.h(mean)[index]


class _GatedResidual(nn.Module):
    """x + sigmoid(gate(x)) * res(x)."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = nn.Sequential(nn.Linear(DIM, DIM), nn.Sigmoid())
        self.res = nn.Sequential(nn.Linear(DIM, DIM), nn.ReLU(), nn.Linear(DIM, DIM))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.gate(x) * self.res(x)


def _mlp() -> nn.Sequential:
    return nn.Sequential(nn.Linear(DIM, DIM), nn.ReLU(), nn.Linear(DIM, DIM))


class UpdateNetwork(nn.Module):
    """One recurrent step for all edges: hidden state, pixel correction and its weight."""

    def __init__(self) -> None:
        super().__init__()
        self.c1, self.c2 = _mlp(), _mlp()
        self.norm = nn.LayerNorm(DIM, eps=_EPS)
        self.agg_kk, self.agg_ij = _SoftAggregation(), _SoftAggregation()
        norms = nn.LayerNorm(DIM, eps=_EPS), nn.LayerNorm(DIM, eps=_EPS)
        self.gru = nn.Sequential(norms[0], _GatedResidual(), norms[1], _GatedResidual())
        self.corr = nn.Sequential(
            nn.Linear(_CORRELATIONS, DIM),
            nn.ReLU(),
            nn.Linear(DIM, DIM),
            nn.LayerNorm(DIM, eps=_EPS),
            nn.ReLU(),
            nn.Linear(DIM, DIM),
        )
        self.d = nn.Sequential(nn.ReLU(), nn.Linear(DIM, 2))
        self.w = nn.Sequential(nn.ReLU(), nn.Linear(DIM, 2), nn.Sigmoid())

    def forward(
        self, hidden: Tensor, context: Tensor, corr: Tensor, patch: Tensor, source: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """hidden, context [E, 384], corr [E, 882]; patch, source and target frame of each edge [E] int64.

        Returns:
            hidden [E, 384], correction [E, 2] px at quarter resolution, weight [E, 2] in 0..1.
        """
        hidden = self.norm(hidden + context + self.corr(corr))
        before, after = _neighbours(patch, target)
        hidden = hidden + self.c1(_gather(hidden, before))
        hidden = hidden + self.c2(_gather(hidden, after))
        hidden = hidden + self.agg_kk(hidden, patch)
        hidden = hidden + self.agg_ij(hidden, source * 12345 + target)
        hidden = self.gru(hidden)
        return hidden, self.d(hidden), self.w(hidden)


def _neighbours(patch: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Edge of the same patch with the previous and with the next target frame, [E] each, -1: none."""
    order = torch.argsort(patch * (int(target.max()) + 1) + target)
    same = patch[order][1:] == patch[order][:-1]
    before, after = torch.full_like(patch, -1), torch.full_like(patch, -1)
    before[order[1:][same]] = order[:-1][same]
    after[order[:-1][same]] = order[1:][same]
    return before, after


def _gather(x: Tensor, index: Tensor) -> Tensor:
    """Rows of x at ``index``; zero where it is -1."""
    return x[index.clamp(min=0)] * (index >= 0)[:, None]


class _Patchifier(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.fnet = Encoder(FEATURES, norm=True)
        self.inet = Encoder(DIM, norm=False)


class DPVONetwork(nn.Module):
    """Encoders and update; ``state_dict`` has the names of the official checkpoint."""

    def __init__(self) -> None:
        super().__init__()
        self.patchify = _Patchifier()
        self.update = UpdateNetwork()

    @staticmethod
    def load(path: Path) -> DPVONetwork:
        """The network with a checkpoint's weights.

        Raises:
            ConfigError: the file cannot be read, or its tensors are not those of this network.
        """
        try:
            found = torch.load(path, map_location="cpu", weights_only=True)
            given = {str(k).removeprefix("module."): v for k, v in found.items() if isinstance(v, Tensor)}
        except Exception as error:  # whatever a damaged file makes the reader raise
            raise ConfigError(f"cannot read checkpoint {path}: {error}; give the official dpvo.pth") from error
        given.pop("update.lmbda", None)
        network = DPVONetwork()
        wanted = network.state_dict()
        wrong = [k for k in wanted if k not in given or given[k].shape != wanted[k].shape]
        wrong += [k for k in given if k not in wanted]
        if wrong:
            raise ConfigError(
                f"checkpoint {path} does not fit the DPVO network: {len(wrong)} of {len(wanted)} tensors are missing, "
                f"unknown or of another shape, the first is '{wrong[0]}'; give the official dpvo.pth"
            )
        network.load_state_dict(given)
        return network.eval()


def correlate(patches: Tensor, features: Tensor, coords: Tensor) -> Tensor:
    """Correlation of patches with the target around where they are expected, [E, 882].

    Args:
        patches: [E, 128, 3, 3] features of the patches.
        features: [1, 128, h, w] of the target at quarter resolution.
        coords: [E, 3, 3, 2] (x, y) of the patch pixels there, pixel centres at integers.

    Flattened as (dx, dy, patch row, patch column, level), the last fastest.
    """
    span = torch.arange(-RADIUS, RADIUS + 1, dtype=coords.dtype)
    offset = torch.stack(torch.meshgrid(span, span, indexing="ij"), dim=-1)  # [dx, dy, (x, y)]
    out = []
    for pooling in LEVELS:
        level = features if pooling == 1 else functional.avg_pool2d(features, pooling)
        at = coords[:, None, None] / pooling + offset[None, :, :, None, None]  # [E, 7, 7, 3, 3, 2]
        size = torch.tensor([level.shape[3], level.shape[2]], dtype=coords.dtype)
        grid = ((2 * at + 1) / size - 1).reshape(1, len(coords), -1, 2)
        sampled = functional.grid_sample(level, grid, align_corners=False)[0]  # [128, E, 441]
        sampled = sampled.reshape(FEATURES, len(coords), *at.shape[1:5])
        out.append(torch.einsum("cexyrs,ecrs->exyrs", sampled, patches))
    return torch.stack(out, dim=-1).flatten(1)
