"""The operations of ATen that a program may call: those of a forward pass that read and write nothing beyond their arguments.

ATen has some 1,400 operations. Many trust the sizes and indices that they are given and read past the end of a tensor; some
open files. So what may be called is listed, and sizes that a kernel does not check itself are checked here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload, OpOverloadPacket

from bench.victims.drivers.from_file import RefusedError

NAMES = """
    abs absolute acos acosh add addcdiv addcmul arccos arcsin arctan arctan2 asin asinh atan atan2 atanh bitwise_and bitwise_not
    bitwise_or bitwise_xor ceil clamp clamp_max clamp_min clip copysign cos cosh deg2rad div divide erf erfc erfinv exp exp2 expm1
    fix floor floor_divide fmax fmin fmod frac hypot isclose isfinite isinf isnan isneginf isposinf lerp log log10 log1p log2
    logaddexp logical_and logical_not logical_or logical_xor logit maximum minimum mul multiply nan_to_num neg negative positive
    pow rad2deg reciprocal remainder round rsqrt rsub sgn sign sin sinc sinh sqrt square sub subtract tan tanh true_divide trunc
    where xlogy
    eq equal ge greater greater_equal gt le less less_equal lt ne not_equal
    celu elu gelu glu hardshrink hardsigmoid hardswish hardtanh leaky_relu log_sigmoid log_softmax mish prelu relu relu6 selu
    sigmoid silu softmax softplus softshrink softsign threshold _log_softmax _safe_softmax _softmax
    all amax amin aminmax any argmax argmin argsort count_nonzero cummax cummin cumprod cumsum kthvalue linalg_norm
    linalg_vector_norm logcumsumexp logsumexp max mean median min nanmean nansum norm prod sort std std_mean sum topk var var_mean
    addbmm addmm addmv addr baddbmm bilinear bmm chain_matmul cosine_similarity dot einsum inner kron linear linalg_cross
    linalg_multi_dot matmul mm mv outer pairwise_distance tensordot trace _trilinear
    _convolution conv1d conv2d conv3d conv_transpose1d conv_transpose2d convolution
    adaptive_avg_pool1d adaptive_avg_pool2d adaptive_max_pool1d adaptive_max_pool2d avg_pool1d avg_pool2d max_pool1d
    max_pool1d_with_indices max_pool2d max_pool2d_with_indices _adaptive_avg_pool2d
    alpha_dropout batch_norm dropout feature_dropout group_norm instance_norm layer_norm native_group_norm native_layer_norm
    rms_norm _native_batch_norm_legit_no_training _weight_norm
    gru.input scaled_dot_product_attention _scaled_dot_product_flash_attention_for_cpu
    alias as_strided atleast_1d atleast_2d atleast_3d block_diag broadcast_tensors broadcast_to cat channel_shuffle chunk clone
    column_stack concat concatenate constant_pad_nd contiguous copy detach diag diag_embed diagonal dstack expand expand_as
    flatten flip fliplr flipud hstack im2col lift_fresh lift_fresh_copy meshgrid movedim moveaxis narrow numpy_T pad permute
    pixel_shuffle pixel_unshuffle ravel reflection_pad1d reflection_pad2d repeat repeat_interleave.self_int replication_pad1d
    replication_pad2d reshape reshape_as roll rot90 select slice split split_with_sizes squeeze stack swapaxes swapdims t tile
    to transpose tril triu type_as unbind unflatten unfold unsafe_chunk unsafe_split unsqueeze view view_as vstack _to_copy
    _unsafe_view
    embedding gather index index_add index_copy index_fill index_put index_select masked_fill one_hot scatter scatter_add
    scatter_reduce select_scatter slice_scatter take_along_dim
    arange eye fill full full_like linspace new_full new_ones new_zeros ones ones_like scalar_tensor tril_indices triu_indices
    zero zeros zeros_like
    sym_numel sym_size sym_storage_offset sym_stride
"""
"""Names of operations, with the overload where only that is allowed. Each may also change its first argument: `relu_`."""
FORWARD = frozenset(NAMES.split())

Given = Mapping[str, Any]
"""The arguments of an operation by the names in its schema."""


def operation(target: str) -> tuple[OpOverload[..., Any], Callable[..., Any]]:
    """The operation of ATen with this name, and how to call it: with the sizes checked that it does not check itself.

    Raises:
        RefusedError: if there is none, or it is not one of a forward pass.
    """
    named = re.fullmatch(r"torch\.ops\.aten\.(\w+)\.(\w+)", target)
    packet = getattr(torch.ops.aten, named[1], None) if named and not named[1].startswith("__") else None
    found = getattr(packet, named[2], None) if named and isinstance(packet, OpOverloadPacket) else None
    if not named or not isinstance(found, OpOverload):
        raise RefusedError(
            f"it calls {target!r}; only the operations of ATen on tensors (torch.ops.aten) are carried out"
        )
    plain = named[1].removesuffix("_")
    if not {plain, f"{plain}.{named[2]}"} & FORWARD or named[2].endswith("out"):
        raise RefusedError(f"it calls {target!r}, which is not an operation of a forward pass")
    return found, _checked(found, CHECKS[plain]) if plain in CHECKS else found


def _checked(call: OpOverload[..., Any], check: Callable[[Given], str]) -> Callable[..., Any]:
    """The operation, after `check` found nothing wrong with its arguments."""
    arguments = call._schema.arguments
    names, defaults = [one.name for one in arguments], {one.name: one.default_value for one in arguments}

    def checked(*args: Any, **kwargs: Any) -> Any:
        if why := check(defaults | dict(zip(names, args, strict=False)) | kwargs):
            raise RefusedError(why)
        return call(*args, **kwargs)

    return checked


def _batch_norm(given: Given) -> str:
    """Torch reads one number for each channel, even if there are fewer."""
    if given.get("training"):
        return "it changes its own weights: export it in eval mode"
    per_channel = (given[name] for name in ("weight", "bias", "running_mean", "running_var"))
    if any(one is not None and one.shape != given["input"].shape[1:2] for one in per_channel):
        return "a batch norm has weights or statistics of another size than its input"
    return ""


def _instance_norm(given: Given) -> str:
    if given["use_input_stats"] and (given["running_mean"] is not None or given["running_var"] is not None):
        return "it changes its own weights: export it in eval mode"
    return _batch_norm(given)


def _group_norm(given: Given) -> str:
    """Torch reads as many numbers as the sizes say."""
    input, sizes = given["input"], [given[name] for name in ("N", "C", "HxW")]
    if list(input.shape[:2]) != sizes[:2] or input.numel() != math.prod(sizes):
        return "a group norm has other sizes than its input"
    return ""


def _attention(given: Given) -> str:
    """The kernel takes the sizes of all from the query and the key."""
    query, key, value, mask = (given[name] for name in ("query", "key", "value", "attn_mask"))
    alike = key.shape[:-1] == value.shape[:-1] and query.shape[-1] == key.shape[-1]
    private = "enable_gqa" not in given
    if private:
        alike &= query.dim() == 4 and query.shape[:2] == key.shape[:2] and key.shape == value.shape
    if not alike:
        return "an attention has queries, keys and values whose sizes do not fit"
    wanted = (*query.shape[:-1], key.shape[-2])
    if mask is not None and (not _expands(mask, wanted) or (private and mask.dim() not in (2, 4))):
        return "an attention has a mask of another size than its queries and keys"
    return ""


def _expands(mask: Tensor, wanted: tuple[int, ...]) -> bool:
    last = wanted[max(0, len(wanted) - mask.dim()) :]
    return len(last) == mask.dim() and all(side in (1, most) for side, most in zip(mask.shape, last, strict=True))


def _weight_norm(given: Given) -> str:
    """Torch reads one length for each row of the direction, even if there are fewer."""
    direction, length, dim = given["v"], given["g"], given["dim"]
    if not 0 <= dim < direction.dim():
        return "a weight norm has an axis that its weight does not have"
    if list(length.shape) != [side if axis == dim else 1 for axis, side in enumerate(direction.shape)]:
        return "a weight norm has lengths of another size than its weight"
    return ""


CHECKS: Mapping[str, Callable[[Given], str]] = {
    "batch_norm": _batch_norm,
    "_native_batch_norm_legit_no_training": _batch_norm,
    "instance_norm": _instance_norm,
    "native_group_norm": _group_norm,
    "scaled_dot_product_attention": _attention,
    "_scaled_dot_product_flash_attention_for_cpu": _attention,
    "_weight_norm": _weight_norm,
}
"""What to check before an operation is called: why its arguments are refused, or nothing."""
