"""Arguments of gsplat's functions that belong together."""

import pytest
import torch

from sgwarp.compat import gsplat
from sgwarp.compat.gsplat.relocation import compute_relocation
from sgwarp.errors import InputError


def test_arguments_of_gsplat_that_belong_together():
    row, zeros = torch.zeros(3, 2), torch.zeros(3)
    for given, missing in (({"n_images": 1}, "image_ids"), ({"image_ids": torch.zeros(3).long()}, "n_images")):
        with pytest.raises(InputError, match=f"{missing}: needed with packed=True"):
            gsplat.isect_tiles(row, row.int(), zeros, 16, 2, 2, packed=True, **given)
    scene = (torch.zeros(3, 3), None, torch.ones(3, 4), torch.ones(3, 3), torch.eye(4)[None], torch.eye(3)[None], 8, 8)
    with pytest.raises(InputError, match="sparse_grad: only possible with packed=True"):
        gsplat.fully_fused_projection(*scene, sparse_grad=True)
    for binoms in (torch.zeros(0, 0), torch.zeros(3, 4), torch.zeros(3)):
        with pytest.raises(InputError, match="binoms: expected"):
            compute_relocation(zeros, torch.ones(3, 3), torch.ones(3, dtype=torch.int32), binoms)
