"""Generate C code of CasADi functions, and the information needed to call it without CasADi.

Each function ``NAME`` as CasADi generates it (dense matrices, by columns) is accompanied by
``NAME_rows``, which evaluates it for rows of NumPy arrays (matrices by rows).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca

HEADER_NAME = "functions.h"

_HEADER = """\
#ifndef STIFFOPT_FUNCTIONS_H
#define STIFFOPT_FUNCTIONS_H

#include <stdint.h>

#define casadi_real double
#define casadi_int long long int

"""

_ROWS = """
#include <stdint.h>

/* Evaluate rows begin to end - 1 of arrays; `stride` numbers separate the rows of each. */
int {name}_rows(const double* const* in, const int64_t* stride, double* const* out,
                int64_t begin, int64_t end, double* w, casadi_int* iw) {{
  const double* arg[{sz_arg}];
  double* res[{sz_res}];
{buffers}
  for (int64_t row = begin; row < end; ++row) {{
{before}
    if ({name}(arg, res, iw, w, 0)) return 1;
{after}
  }}
  return 0;
}}
"""


@dataclass(frozen=True)
class Signature:
    """Shapes of a function's arguments and results, and the sizes of its work memory."""

    inputs: tuple[tuple[int, int], ...]
    outputs: tuple[tuple[int, int], ...]
    sz_arg: int
    sz_res: int
    sz_iw: int
    sz_w: int

    @classmethod
    def of(cls, function: ca.Function) -> Self:
        """Return the signature of a CasADi function."""
        return cls(
            tuple(function.size_in(k) for k in range(function.n_in())),
            tuple(function.size_out(k) for k in range(function.n_out())),
            function.sz_arg(),
            function.sz_res(),
            function.sz_iw(),
            function.sz_w(),
        )

    @classmethod
    def from_mapping(cls, mapping: dict[str, Any]) -> Self:
        """Return the signature from its fields, as read from JSON."""

        def shapes(key: str) -> tuple[tuple[int, int], ...]:
            return tuple((int(rows), int(columns)) for rows, columns in mapping[key])

        sizes = (int(mapping[key]) for key in ("sz_arg", "sz_res", "sz_iw", "sz_w"))
        return cls(shapes("inputs"), shapes("outputs"), *sizes)


def dense(function: ca.Function) -> ca.Function:
    """Return the same function with dense arguments and results."""
    ends = [function.sparsity_in(k) for k in range(function.n_in())]
    ends += [function.sparsity_out(k) for k in range(function.n_out())]
    if all(sparsity.is_dense() for sparsity in ends):
        return function
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    inputs = [kind.sym("x", *function.size_in(k)) for k in range(function.n_in())]
    outputs = [ca.densify(value) for value in function.call(inputs)]
    return ca.Function(function.name(), inputs, outputs)


def function_of(name: str, inputs: list[Any], outputs: list[Any]) -> ca.Function:
    """Return a function with dense results, whose common subexpressions are evaluated once."""
    return ca.Function(name, inputs, ca.cse([ca.densify(output) for output in outputs]))


def c_code(function: ca.Function) -> str:
    """Return the text of a C file with a dense function ``NAME`` and its ``NAME_rows``."""
    generator = ca.CodeGenerator(f"{function.name()}.c", {"with_header": False})
    generator.add(function)
    text = str(generator.dump()).replace(
        "\ncasadi_real casadi_", "\nstatic inline casadi_real casadi_"
    )
    return text + _rows_code(function.name(), Signature.of(function))


def header(signatures: dict[str, Signature]) -> str:
    """Return ``functions.h``: prototypes and sizes for hand-written C.

    For a function NAME it has ``NAME_N_IN``, ``NAME_N_OUT``, ``NAME_SZ_ARG``, ``NAME_SZ_RES``,
    ``NAME_SZ_IW``, ``NAME_SZ_W`` with the name in capitals.  ``WORK_ARG``, ``WORK_RES``,
    ``WORK_IW`` and ``WORK_W`` are large enough for all functions, and at least one.
    """
    lines = []
    for name, signature in signatures.items():
        sizes = {
            "N_IN": len(signature.inputs),
            "N_OUT": len(signature.outputs),
            "SZ_ARG": signature.sz_arg,
            "SZ_RES": signature.sz_res,
            "SZ_IW": signature.sz_iw,
            "SZ_W": signature.sz_w,
        }
        lines += [f"#define {name.upper()}_{key} {size}" for key, size in sizes.items()]
        lines.append(
            f"int {name}(const double** arg, double** res, casadi_int* iw, double* w, int mem);\n"
        )
    for kind in ("arg", "res", "iw", "w"):
        largest = max((getattr(each, f"sz_{kind}") for each in signatures.values()), default=0)
        lines.append(f"#define WORK_{kind.upper()} {max(1, largest)}")
    return _HEADER + "\n".join(lines) + "\n\n#endif\n"


def _rows_code(name: str, signature: Signature) -> str:
    buffers, before, after = [], [], []
    for k, (rows, columns) in enumerate(signature.inputs):
        own = f"in[{k}] + row * stride[{k}]"
        if _is_vector(rows, columns):
            before.append(f"arg[{k}] = {own};")
            continue
        buffers.append(f"double x{k}[{rows * columns}];")
        before.append(f"const double* from{k} = {own};")
        before += _transposition(rows, columns, f"x{k}", f"from{k}", to_columns=True)
        before.append(f"arg[{k}] = x{k};")
    for k, (rows, columns) in enumerate(signature.outputs):
        own = f"out[{k}] + row * {rows * columns}"
        if _is_vector(rows, columns):
            before.append(f"res[{k}] = {own};")
            continue
        buffers.append(f"double y{k}[{rows * columns}];")
        before.append(f"res[{k}] = y{k};")
        after.append(f"double* to{k} = {own};")
        after += _transposition(rows, columns, f"to{k}", f"y{k}", to_columns=False)
    return _ROWS.format(
        name=name,
        sz_arg=max(1, signature.sz_arg),
        sz_res=max(1, signature.sz_res),
        buffers=_indented(buffers, 2),
        before=_indented(before, 4),
        after=_indented(after, 4),
    )


def _is_vector(rows: int, columns: int) -> bool:
    return rows <= 1 or columns <= 1


def _transposition(rows: int, columns: int, to: str, source: str, to_columns: bool) -> list[str]:
    by_row, by_column = f"i * {columns} + j", f"j * {rows} + i"
    target, origin = (by_column, by_row) if to_columns else (by_row, by_column)
    return [
        f"for (int i = 0; i < {rows}; ++i)",
        f"  for (int j = 0; j < {columns}; ++j) {to}[{target}] = {source}[{origin}];",
    ]


def _indented(lines: Sequence[str], width: int) -> str:
    return "\n".join(" " * width + line for line in lines)
