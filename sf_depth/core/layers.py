"""The mean of the Gaussian process: the image as layers of planes, drawn from the observations.

Every observation extends its plane to the pixel. Their weighted median decides which surface the pixel shows,
so a depth edge stays an edge; the average of those that agree with it is the mean.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import torch

from sf_depth.core.conditioning import Observations
from sf_depth.core.parallel import each

_TRUST = 6.0  # a plane is extended this many spacings of its observations; at this distance it counts half
_CLIP = 1.3  # and changes by this factor at most
_AGREE = 0.03  # relative deviation of planes that belong to one surface
_SUSPECT = (
    1.0  # log distance behind its surroundings at which an observation counts half, with scattered ones half that
)
_NEARER = 0.065  # what scattered observations move the median by, towards the near
_SAMPLES = (1 / 6, 1 / 3, 1 / 2, 2 / 3, 5 / 6)  # where the colour is looked up between a pixel and an observation
_BARRIER = 0.7  # how much a colour step in between counts against one at the ends
_CHUNK = 8192  # observations weighed at once; fewer keep the cores waiting for the interpreter
_SOFT = 0.25  # share of the spacing below which all observations are equally near


@dataclass(frozen=True, slots=True)
class Neighbourhood:
    """What ``B`` tiles of ``M`` pixels see of the ``K`` observations that they are conditioned on."""

    ids: torch.Tensor  # [B, K]
    value: torch.Tensor  # [B, K, M] ratio that each observation's plane predicts
    square: torch.Tensor  # [B, K, M] px^2, distance
    affinity: torch.Tensor  # [B, K, M] (0, 1], alike in colour and within reach


@dataclass(frozen=True, slots=True)
class Layer:
    """The surface that pixels show, [B, M] each."""

    ratio: torch.Tensor  # base / z
    spread: torch.Tensor  # variance of log z between the observations' opinions


def look(observed: Observations, ids: torch.Tensor, x: torch.Tensor, color: torch.Tensor) -> Neighbourhood:
    """Neighbourhoods of pixels ``x`` [B, M, 2] (col, row), given colours [H, W, C] in units of their scale."""
    seen = observed.x[ids]  # [B, K, 2]
    center = x.mean(dim=1, keepdim=True)
    d = (x - center).transpose(1, 2)[:, :, None] - (seen - center).transpose(1, 2)[..., None]  # [B, 2, K, M]
    dx, dy = d[:, 0], d[:, 1]
    square = dx * dx + dy * dy
    slope, spacing, ratio = observed.slope[ids], observed.spacing[ids], observed.ratio[ids][..., None]
    rise = dx * slope[..., :1] + dy * slope[..., 1:]
    reach = square * (1.0 / (_TRUST * spacing[..., None]) ** 2)
    rise *= torch.rsqrt(reach.clamp_min(1.0))
    value = torch.minimum(torch.maximum(ratio + rise, ratio / _CLIP), ratio * _CLIP)
    own, there = at(color, x), at(color, seen)
    step = torch.zeros_like(spacing)
    for share in _SAMPLES:
        between = at(color, torch.round(seen + share * (center - seen)))
        step = torch.maximum(step, ((between - there) ** 2).sum(dim=2))
    off = (own * own).sum(2)[:, None] + (there * there).sum(2)[..., None] - 2.0 * there @ own.transpose(1, 2)
    off = torch.maximum(off, _BARRIER * step[..., None])
    affinity = off.add_(1.0).mul_(reach.add_(1.0)).reciprocal_()
    return Neighbourhood(ids, value, square, affinity)


def at(image: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Pixels of ``image`` [H, W, C] at integer (col, row) [..., 2]."""
    return image[x[..., 1].long(), x[..., 0].long()]


def layer(seen: Neighbourhood, reliability: torch.Tensor, spacing: torch.Tensor, apart: float) -> Layer:
    """Weighted median of what the planes predict, then the average of those that agree with it.

    Args:
        apart: px, up to 1, by which depth may lie beside where the image shows it. Then points of the background lie
            on what is in front, which the camera sees: the median is a little on the near side.
    """
    trust = seen.affinity * reliability[seen.ids][..., None]
    sharp = trust / (seen.square + 1e-3)
    ratio = _smooth(seen, _quantile(seen.value, sharp, 0.5 + _NEARER * apart), trust, spacing)
    off = torch.log(seen.value / ratio[:, None])
    return Layer(ratio, (sharp * off * off).sum(dim=1) / sharp.sum(dim=1))


def _smooth(seen: Neighbourhood, start: torch.Tensor, trust: torch.Tensor, spacing: torch.Tensor) -> torch.Tensor:
    """Average of the planes that agree with ``start`` [B, M], the nearer the heavier, [B, M]."""
    off = (seen.value / start[:, None] - 1.0) / _AGREE
    weight = trust / ((seen.square + (_SOFT * spacing[seen.ids][..., None]) ** 2) * (1.0 + off * off) ** 2)
    return (weight * seen.value).sum(dim=1) / weight.sum(dim=1)


def _quantile(value: torch.Tensor, weight: torch.Tensor, share: float = 0.5) -> torch.Tensor:
    """Weighted quantile over the observations, [B, M]; their order is that at each tile's middle pixel."""
    order = value[..., value.shape[2] // 2].argsort(dim=1)[..., None].expand_as(value)
    total = weight.gather(1, order).cumsum(dim=1)
    middle = (total < share * total[:, -1:]).sum(dim=1, keepdim=True)
    return value.gather(1, order.gather(1, middle))[:, 0]


def reliability(observed: Observations, color: torch.Tensor, apart: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Weight of every observation, [N], and the ratio of the layer that it lies on, [N].

    A point that lies behind all that surround it was seen past an edge or through glass: the sensor does not
    stand where the camera does, and the camera sees what is in front.
    """
    ids = torch.cat([torch.arange(len(observed.ratio))[:, None], observed.near], dim=1)
    suspect = _SUSPECT / (1.0 + apart)

    def weigh(part: torch.Tensor) -> tuple[Neighbourhood, torch.Tensor]:
        seen = look(observed, part, observed.x[part[:, :1]], color)
        around = _quantile(seen.value[:, 1:], seen.affinity[:, 1:] / (seen.square[:, 1:] + 1e-3))[:, 0]
        behind = torch.log(around / observed.ratio[part[:, 0]]).clamp_min(0.0) / suspect
        return seen, 1.0 / (1.0 + behind * behind)

    def settle(seen: Neighbourhood) -> torch.Tensor:
        trust = seen.affinity * weight[seen.ids][..., None]
        return _smooth(seen, observed.ratio[seen.ids[:, :1]], trust, observed.spacing)[:, 0]

    looked, weights = zip(*each(weigh, ids.split(_CHUNK)), strict=True)
    weight = torch.cat(weights)
    return weight, torch.cat(each(settle, looked))
