"""A normalised gaze field in plain PyTorch: what `torch_frames` puts beside ours."""

from __future__ import annotations

from torch_radiance import harmonics

import numpy as np


class Attention:
    """Gaze as a density that integrates to one over an observer's sphere, of the weights of a ``model`` (`TorchModel`):
    `nerg_mi.field.gaze.log_density`."""

    def __init__(self, model):
        import torch

        self.model, self.config = model, model.config
        self.degree = self.config.sh_degree**2
        low, high = torch.tensor(self.config.heads)
        self.low, self.scale = low, 2 / (high - low).max()
        self.end = (high - low) * self.scale - 1

    def log_blind(self, r_o):
        """Log of the density that knows no positions, bilinear in its table of latitudes and longitudes."""
        import torch

        table = self.model.weights["prior"].detach()
        rows, columns = table.shape
        x = torch.atan2(r_o[:, 1], r_o[:, 0]).remainder(2 * np.pi) * (rows / np.pi) - 0.5
        y = (r_o[:, 2].clamp(-1, 1).acos() * (rows / np.pi) - 0.5).clamp(0, rows - 1)
        i, j = x.floor(), y.floor().clamp(max=rows - 2)
        fx, fy = x - i, y - j
        i, j = i.long() % columns, j.long()
        k = (i + 1) % columns
        upper, lower = (table[r, i].lerp(table[r, k], fx) for r in (j, j + 1))
        return upper.lerp(lower, fy)

    def unnormalized(self, p_od, p_o, r_o, escaped=None):
        """What the integral is made of, 1/sr times a constant of the observer."""
        import torch

        c, weights = self.config, self.model.weights
        ones = torch.ones(len(r_o), 1)
        distance = (p_od - p_o).norm(dim=1, keepdim=True).clamp(min=1e-3 * self.model.box.side).log()
        inputs = [ones, distance, harmonics(-r_o)[:, : self.degree], self.model.encode(p_od)]
        emit = self.model._net("emit_net", torch.cat(inputs, 1))[:, 0]
        if escaped is not None and c.escaped == "constant":
            emit = torch.where(escaped, weights["escaped"].detach(), emit)
        u = torch.minimum((p_o - self.low) * self.scale - 1, self.end).clamp(min=-1)
        waves = [u, (u * (np.pi / 2)).sin(), (u * (np.pi / 2)).cos()]
        capture = self.model._net("capture_net", torch.cat([ones, harmonics(r_o)[:, : self.degree], *waves], 1))
        return (self.log_blind(r_o) + emit).clamp(max=30).exp() * capture[:, 0].sigmoid()

    def gaze(self, p_od, p_o, r_o, integral):
        """Gaze in 1/sr of observers whose ``integral`` is known."""
        mix = self.config.mix
        return (1 - mix) / integral * self.unnormalized(p_od, p_o, r_o) + mix * self.log_blind(r_o).exp()
