"""Where torch computes."""

import torch


def find_device(name: str) -> torch.device:
    """Device of a name such as "cpu", "cuda" or "cuda:1".

    Raises
    ------
    ValueError
        If there is none here.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ValueError(f'device={name!r} is unknown; use "cpu" or "cuda".') from error
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(
            f"device={name!r}: torch finds {torch.cuda.device_count()} CUDA devices here; "
            'use set_params(device="cpu").'
        )
    return device
