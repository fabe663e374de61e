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

from cavbench.formats.trial import RefusedError

NAMES = """
abs absolute acos acosh adaptive_avg_pool1d _adaptive_avg_pool2d adaptive_avg_pool2d adaptive_max_pool1d adaptive_max_pool2d
add addbmm addcdiv addcmul addmm addmv addr adjoint alias all alpha_dropout amax amin aminmax __and__ any arange arccos
arccosh arcsin arcsinh arctan arctan2 arctanh argmax argmin argsort argwhere as_strided asin asinh atan atan2 atanh
atleast_1d atleast_2d atleast_3d avg_pool1d avg_pool2d baddbmm batch_norm bilinear bitwise_and bitwise_left_shift bitwise_not
bitwise_or bitwise_right_shift bitwise_xor block_diag bmm broadcast_tensors broadcast_to bucketize cartesian_prod cat ceil
celu chain_matmul channel_shuffle chunk clamp clamp_max clamp_min clip clone column_stack combinations concat concatenate
constant_pad_nd contiguous conv1d conv2d conv3d conv_transpose1d conv_transpose2d _convolution convolution copy copysign
corrcoef cos cosh cosine_similarity count_nonzero cov cross cummax cummin cumprod cumsum cumulative_trapezoid deg2rad det
detach diag diag_embed diagflat diagonal diagonal_scatter diff digamma dist div divide dot dropout dsplit dstack einsum elu
embedding empty_like eq equal erf erfc erfinv exp exp2 expand expand_as expm1 eye feature_dropout fill fix flatten flip
fliplr flipud float_power floor floor_divide fmax fmin fmod frac frobenius_norm full full_like gather ge gelu ger glu greater
greater_equal group_norm gru.input gt hardshrink hardsigmoid hardswish hardtanh heaviside hsplit hstack huber_loss hypot
im2col index index_add index_copy index_fill index_put index_select inner instance_norm isclose isfinite isin isinf isnan
isneginf isposinf isreal kron kthvalue l1_loss layer_norm ldexp le leaky_relu lerp less less_equal lgamma lift_fresh
lift_fresh_copy linalg_cross linalg_det linalg_diagonal linalg_inv linalg_matmul linalg_matrix_norm linalg_multi_dot
linalg_norm linalg_solve linalg_vecdot linalg_vector_norm linear linspace log log10 log1p log2 log_sigmoid _log_softmax
log_softmax logaddexp logaddexp2 logcumsumexp logical_and logical_not logical_or logical_xor logit logsumexp lstm.input lt mH
mT masked_fill masked_scatter masked_select matmul max max_pool1d max_pool1d_with_indices max_pool2d max_pool2d_with_indices
maximum mean median meshgrid min minimum mish mm mode moveaxis movedim mse_loss msort mul multiply mv nan_to_num nanmean
nanmedian nanquantile nansum narrow _native_batch_norm_legit_no_training native_group_norm native_layer_norm ne neg negative
new_full new_ones new_zeros nonzero norm not_equal numpy_T one_hot ones ones_like __or__ outer pad pairwise_distance permute
pixel_shuffle pixel_unshuffle positive pow prelu prod quantile rad2deg ravel real reciprocal reflection_pad1d
reflection_pad2d relu relu6 remainder renorm repeat repeat_interleave.self_int replication_pad1d replication_pad2d reshape
reshape_as resolve_conj resolve_neg rms_norm rnn_relu.input rnn_tanh.input roll rot90 round row_stack rsqrt rsub
_safe_softmax scalar_tensor scaled_dot_product_attention _scaled_dot_product_flash_attention_for_cpu scatter scatter_add
scatter_reduce select select_scatter selu sgn sigmoid sign signbit silu sin sinc sinh slice slice_scatter smooth_l1_loss
_softmax softmax softplus softshrink sort special_entr special_erf special_erfc special_exp2 special_expit special_expm1
special_log1p special_log_ndtr special_log_softmax special_logit special_logsumexp special_ndtr special_round special_sinc
special_softmax special_xlog1py special_xlogy split split_with_sizes sqrt square squeeze stack std std_mean sub subtract sum
sum_to_size swapaxes swapdims sym_numel sym_size sym_storage_offset sym_stride t take take_along_dim tan tanh tensor_split
tensordot threshold tile to _to_copy topk trace transpose trapezoid tril tril_indices _trilinear triu triu_indices
true_divide trunc type_as unbind unflatten unfold unsafe_chunk unsafe_split _unsafe_view unsqueeze upsample_bicubic2d
upsample_bilinear2d upsample_nearest2d _upsample_nearest_exact2d vander var var_mean vdot view view_as vsplit vstack
_weight_norm where xlogy __xor__ zero zeros zeros_like
"""
"""Names of operations, with the overload where only that is allowed. Each may also change its first argument: `relu_`."""
FORWARD = frozenset(NAMES.split())

FILLED = {"aten::empty_like": torch.ops.aten.zeros_like.default}
"""What is called instead of an operation whose result holds whatever was in the memory before."""

LEAST_SCALE, MOST_SCALE = 1 / 64, 64
"""The scales by which an image may be resized."""
Given = Mapping[str, Any]
"""The arguments of an operation by the names in its schema."""


def operation(target: str) -> tuple[OpOverload[..., Any], Callable[..., Any]]:
    """The operation of ATen with this name, and how to call it: with the sizes checked that it does not check itself.

    Raises:
        RefusedError: if there is none, or it is not one of a forward pass.
    """
    named = re.fullmatch(r"torch\.ops\.aten\.(\w+)\.(\w+)", target)
    packet = getattr(torch.ops.aten, named[1], None) if named else None
    found = getattr(packet, named[2], None) if named and isinstance(packet, OpOverloadPacket) else None
    if not named or not isinstance(found, OpOverload):
        raise RefusedError(
            f"it calls {target!r}; only the operations of ATen on tensors (torch.ops.aten) are carried out"
        )
    plain = named[1].removesuffix("_")
    if not {named[1], plain, f"{plain}.{named[2]}"} & FORWARD or re.search(r"(^|_)out$", named[2]):
        raise RefusedError(f"it calls {target!r}, which is not an operation of a forward pass")
    if found.name() in FILLED:
        return found, FILLED[found.name()]
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


def _recurrent(gates: int) -> Callable[[Given], str]:
    """The check of a recurrent network: each layer and direction has the weights [G, I], [G, H] and, with biases, [G] twice.

    Args:
        gates: G as a multiple of the hidden size H.
    """

    def check(given: Given) -> str:
        input, hidden, params = given["input"], given["hx"], list(given["params"])
        directions = 2 if given["bidirectional"] else 1
        size = hidden.shape[-1]
        wrong = "a recurrent network has weights or states of another size than its layers"
        # A file may name any number of layers.
        if len(params) != (4 if given["has_biases"] else 2) * directions * given["num_layers"]:
            return wrong
        wanted: list[tuple[int, ...]] = []
        for layer in range(given["num_layers"]):
            inputs = directions * size if layer else input.shape[-1]
            own = [(gates * size, inputs), (gates * size, size), *[(gates * size,)] * 2 * given["has_biases"]]
            wanted += own * directions
        fits = [tuple(one.shape) for one in params] == wanted and len(hidden) == directions * given["num_layers"]
        return "" if fits else wrong

    return check


def _lstm(given: Given) -> str:
    """As of any recurrent network, and its two states: the kernel of oneDNN checks no size. A projection is not read."""
    input, states, params = given["input"], list(given["hx"]), list(given["params"])
    wrong = "a recurrent network has weights or states of another size than its layers"
    if input.dim() != 3 or not input.numel() or len(states) != 2 or not params or params[1].dim() != 2:
        return wrong
    layers = (2 if given["bidirectional"] else 1) * given["num_layers"]
    batch = input.shape[0 if given["batch_first"] else 1]
    size = (layers, batch, params[1].shape[-1])
    if any(tuple(state.shape) != size for state in states):
        return wrong
    if any(one.dtype != input.dtype for one in (*states, *params)):
        return "a recurrent network has weights or states of another type than its input"
    return _recurrent(4)({**given, "hx": states[0]})


def _resize(given: Given) -> str:
    """Torch looks up a pixel by the product of its place and a scale, and checks neither that it is a number nor its size."""
    input, size = given["input" if "input" in given else "self"], given.get("output_size")
    scales = given["scale_factors"] if "scale_factors" in given else [given["scales_h"], given["scales_w"]]
    for axis, scale in enumerate(scales or ()):
        fits = scale is None or (
            LEAST_SCALE <= scale <= MOST_SCALE and (not size or abs(input.shape[2 + axis] * scale - size[axis]) <= 1)
        )
        if not fits:
            return "an image is resized by a scale that does not fit its size"
    return ""


CHECKS: Mapping[str, Callable[[Given], str]] = {
    "batch_norm": _batch_norm,
    "_native_batch_norm_legit_no_training": _batch_norm,
    "instance_norm": _instance_norm,
    "native_group_norm": _group_norm,
    "scaled_dot_product_attention": _attention,
    "_scaled_dot_product_flash_attention_for_cpu": _attention,
    "_weight_norm": _weight_norm,
    "upsample_nearest2d": _resize,
    "_upsample_nearest_exact2d": _resize,
    "upsample_bilinear2d": _resize,
    "upsample_bicubic2d": _resize,
    "gru": _recurrent(3),
    "lstm": _lstm,
    "rnn_relu": _recurrent(1),
    "rnn_tanh": _recurrent(1),
}
"""What to check before an operation is called: why its arguments are refused, or nothing."""
