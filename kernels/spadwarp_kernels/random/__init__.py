"""Random numbers: Philox, uniforms, binomial counts, quantiles, tabulated densities."""

from .binomial import binomial, uniforms
from .density_tables import (
    DensityTables,
    fold,
    folded_quadrature,
    make_density_tables,
    table_cumulative,
    table_density,
    table_sample,
    tabulate,
)
from .philox import (
    RoundKeys,
    philox4x32,
    random_block,
    random_block_keyed,
    round_keys,
    u01,
    u01_fine,
    u01_high,
    u01_low,
    u01_open,
    u01_tail,
)
from .quantiles import count_quantile
from .splitmix import begin_sequence, join_words, sequence_word, step_sequence

__all__ = [
    "DensityTables",
    "RoundKeys",
    "begin_sequence",
    "binomial",
    "count_quantile",
    "fold",
    "folded_quadrature",
    "join_words",
    "make_density_tables",
    "philox4x32",
    "random_block",
    "random_block_keyed",
    "round_keys",
    "sequence_word",
    "step_sequence",
    "table_cumulative",
    "table_density",
    "table_sample",
    "tabulate",
    "u01",
    "u01_fine",
    "u01_high",
    "u01_low",
    "u01_open",
    "u01_tail",
    "uniforms",
]
