"""Messages between the pixels of a line about their depths, by one warp for each line; CUDA alone.

Viterbi's forward and backward sums of log-likelihoods, where a depth may change to the next bin or to any other at a
penalty: min-sum belief propagation on a line, and the paths of semi-global matching (Felzenszwalb and Huttenlocher,
IJCV 70, 41 (2006); Hirschmüller, IEEE TPAMI 30, 328 (2008)).
"""

import warp as wp

from spadwarp_kernels.base.kernels import memoised

__all__ = ["launch_messages"]

wp.set_module_options({"enable_backward": False})

# A lane has the bins lane, lane + 32, …, so that all read memory side by side.
_PASS_ON = """
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31;
    const unsigned int all = 0xffffffffu;
    const float none = -1e30f;
    #pragma unroll
    for (int i = 0; i < VALUES; ++i) if (lane + 32 * i < bins) out.data[start + lane + 32 * i] = 0.0f;
    for (int way = 0; way < 2; ++way) {
        float sent[VALUES];
        #pragma unroll
        for (int i = 0; i < VALUES; ++i) sent[i] = 0.0f;
        for (int step = 0; step < places - 1; ++step) {
            const int at = start + (way ? places - 1 - step : step) * stride;
            const int to = way ? at - stride : at + stride;
            float now[VALUES];
            float best = none;
            #pragma unroll
            for (int i = 0; i < VALUES; ++i) {
                const int bin = lane + 32 * i;
                now[i] = bin < bins ? score.data[at + bin] + sent[i] : none;
                best = fmaxf(best, now[i]);
            }
            for (int apart = 16; apart; apart >>= 1) best = fmaxf(best, __shfl_xor_sync(all, best, apart));
            #pragma unroll
            for (int i = 0; i < VALUES; ++i) {
                float nearer = __shfl_sync(all, now[i], (lane + 31) & 31);
                float farther = __shfl_sync(all, now[i], (lane + 1) & 31);
                const float last = i > 0 ? __shfl_sync(all, now[i > 0 ? i - 1 : 0], 31) : none;
                const float first = i < VALUES - 1 ? __shfl_sync(all, now[i < VALUES - 1 ? i + 1 : i], 0) : none;
                if (lane == 0) nearer = last;
                if (lane == 31) farther = first;
                const float other = fmaxf(best - jump, fmaxf(nearer, farther) - slope);
                sent[i] = fmaxf(now[i], other) - best;
                const int bin = lane + 32 * i;
                if (bin < bins) out.data[to + bin] = sent[i] + (way ? out.data[to + bin] : 0.0f);
            }
        }
    }
#endif
"""


@memoised
def _make_kernel(values: int) -> wp.Kernel:
    """For at most 32 `values` bins."""

    @wp.func_native(_PASS_ON.replace("VALUES", str(values)))
    def pass_on(
        score: wp.array[float], out: wp.array[float], start: int, bins: int, places: int, stride: int, jump: float,
        slope: float,
    ): ...  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False)
    def send(
        score: wp.array[float], out: wp.array[float], beside: int, line_step: int, frame_step: int, bins: int,
        places: int, stride: int, jump: float, slope: float,
    ):  # fmt: skip
        line = wp.tid() / 32
        start = (line / beside) * frame_step + (line % beside) * line_step
        pass_on(score, out, start, bins, places, stride, jump, slope)

    return send


def launch_messages(
    score: wp.array, out: wp.array, shape: tuple[int, int, int, int], *, columns: bool, jump: float, slope: float,
    stream: wp.Stream,
) -> None:  # fmt: skip
    """The sum of both messages to each pixel of a line, into `out`.

    Args:
        score: Log-likelihoods [nats], float32, flat, of frames, rows, columns and bins.
        out: As `score`.
        shape: Of both.
        columns: Lines are columns, else rows.
        jump: Penalty of any other depth [nats].
        slope: Penalty of the next bin [nats].
        stream: Where it runs.
    """
    frames, height, width, bins = shape
    row = width * bins
    beside, line_step, places, stride = (width, bins, height, row) if columns else (height, row, width, bins)
    values = next(count for count in (1, 2, 3, 4, 6, 8, 13, 16, 32) if 32 * count >= bins)
    wp.launch(
        _make_kernel(values), dim=32 * frames * beside,
        inputs=[score, out, beside, line_step, height * row, bins, places, stride, jump, slope],
        stream=stream, block_dim=256,
    )  # fmt: skip
