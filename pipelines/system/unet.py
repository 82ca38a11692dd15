"""The U-Net (Ronneberger et al., MICCAI 2015) of the networks that come with the program."""

import itertools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval


class _Block(nn.Module):
    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.one = nn.Conv2d(before, after, 3, padding=1, bias=False)
        self.two = nn.Conv2d(after, after, 3, padding=1, bias=False)
        self.n1, self.n2 = nn.BatchNorm2d(after), nn.BatchNorm2d(after)

    def fuse(self) -> None:
        """Take the normalisation into the convolutions."""
        for conv, norm in (("one", "n1"), ("two", "n2")):
            setattr(self, conv, fuse_conv_bn_eval(getattr(self, conv), getattr(self, norm)))
            setattr(self, norm, nn.Identity())

    def forward(self, x: Tensor) -> Tensor:
        return self.n2(self.two(self.n1(self.one(x)).relu_())).relu_()


class UNet(nn.Module):
    """Levels of `widths`, each at half the size of the one before, from `before` channels to `after`."""

    def __init__(self, before: int, widths: Sequence[int], after: int) -> None:
        super().__init__()
        self.down = nn.ModuleList(_Block(a, b) for a, b in zip((before, *widths), widths, strict=False))
        self.up = nn.ModuleList(_Block(b + a, a) for a, b in itertools.pairwise(widths))
        self.out = nn.Conv2d(widths[0], after, 1)

    def forward(self, planes: Tensor) -> Tensor:
        """Map planes (B, before, h, w) to (B, after, h, w)."""
        height, width = planes.shape[2:]
        x = F.pad(planes.to(self.out.weight.dtype), (0, -width % 8, 0, -height % 8), mode="replicate")
        stack = []
        for level, down in enumerate(self.down):
            x = down(x if level == 0 else F.avg_pool2d(x, 2))
            stack.append(x)
        stack.pop()
        for up in reversed(self.up):
            x = up(torch.cat([F.interpolate(x, scale_factor=2, mode="nearest"), stack.pop()], 1))
        found: Tensor = self.out(x)[:, :, :height, :width]
        return found.float()

    def fuse(self) -> None:
        """Take the normalisations into the convolutions, for a network that learns no more."""
        for block in (*self.down, *self.up):
            block.fuse()

    def lighten(self) -> None:
        """Convolve in bfloat16 on processors that multiply such numbers, in less than half of the time."""
        if getattr(torch.cpu, "_is_avx512_bf16_supported", bool)():
            for part in (self.down, self.up, self.out):
                part.bfloat16()
