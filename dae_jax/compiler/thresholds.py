"""Where the compiler changes its mind: each threshold with what was measured for it."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Thresholds:
    """Numbers that say how code is written, none of which changes what it computes.

    Arrays:
    - `carried`: entries up to which an array is kept in registers where a loop carries it, where it is an argument, and where
      lanes hold it. More phi nodes than these are spilled.
    - `few`: entries up to which an array in memory is read into registers by an operation on one element.
    - `in_registers`: entries up to which an operation on registers writes out its result entry by entry; what is larger is a loop.
    - `folded`: entries up to which what a constant gives is worked out while compiling; larger ones are data of the module.
    - `per_turn`: entries that the body of a loop over an array has written out at most. More gain nothing, and take longer to compile.
    - `vectors`: entries that a loop over an array works out at once, the most that there are; fewer are done one by one. LLVM's passes
      make such loops too, where they run: in a kernel that is too long for them a linkage in space takes half the time.
    - `stack_bytes`: bytes of a buffer that the stack holds; larger ones are taken from the heap, all at once.
    - `heap_bytes`: bytes of memory that a function may take for its arrays, all lanes of a vector together.
    - `thread_bytes`: bytes of a buffer that a thread on a GPU has of its own, since the device keeps as much for each that may run;
      larger ones are in a buffer of XLA's that all threads share, number beside number.
    - `fused_depth`: operations in one loop; more would nest our own calls too deep.
    - `vectorised`: turns from which on LLVM may make a loop over an array one of vectors. Of 11 it gains nothing by that, and takes a
      third more time: the pendulum by dummy derivatives and Radau is ready in 7.1 s in place of 8.4; the double pendulum by Radau,
      whose loops have 14 and more, takes 8.2 ms so and 10.7 without.
    - `long_loop`: turns from which on loops use the machine's longest vectors: a chain of 64 pendulums gains 15 %, arrays of ten
      lose 25 %.

    Control flow:
    - `written_out`, `numbers_written_out`: equations, and the numbers they give, of all turns of a loop of a known number of turns, up to
      which these stand one after another: of 20 turns with vectors of 23 it takes a sixth more lines of a whole solve, and as long.
    - `turns_written_out`: numbers that all turns compute, up to which a loop is written out whose number of turns is known but for
      one, as diffrax's over stages: 64 double pendulums by Dopri8 (4,600) take 66 µs in place of 169; of chains of 8 (24,000) each
      takes as long as before, and three times as long to compile.
    - `compaction`: what a compaction of lanes costs, in turns of the loop of all lanes.

    Factorisations and sorting, which stand for LAPACK's and for XLA's:
    - `matrix_written_out`: rows up to which a factorisation has every entry in a register. Systems of 4 and of 8 unknowns take 0.09
      and 0.27 µs so, 0.18 and 0.72 in loops, 1.1 and 1.5 by LAPACK; of 8 twice the time to compile.
    - `triangle_written_out`: the same of Cholesky's, and of triangular systems. A body in space has blocks of 7: the six loops of a
      Stewart platform, with 13 of them, by DOP853 take 730 µs a step so and 880 in loops, and as long to compile.
    - `largest_matrix`: rows above which it is LAPACK's, which is called: with 32 it takes 21 µs and LAPACK 9, with 64 it is 310 and 33.
    - `longest_sort`: entries above which sorting, by comparing all pairs, is left to XLA: 64 take 5 µs and XLA's 3, 256 66 and 15.

    Size:
    - `instructions`: more take minutes to compile. A four-bar linkage by dummy derivatives (75,000) is ready in 8 s and takes 7.3 ms, by
      XLA's single kernel in 15 s and takes 20; of more than 200,000 XLA takes longer than anybody waits (see `emit.object_code`).
    - `ptx_lines`: lines of PTX above which NVIDIA's compiler optimises less: the gradient of a chain of 12 links (26,000) takes it
      5 s in place of 24, with a third less that does not fit into registers; of 8 links (25,000) 5 in place of 8.
    - `overestimate`: the estimate counts up to this many instructions for each that is written, since it knows of no zeros and of
      nothing that is there twice. In between the function is written to see.
    - `whole`, `procedure`: in a program of more than `whole` instructions, before equal ones are found (a quarter to two thirds are
      left), a function that is called at several places is a procedure if it has more than `procedure`. A body in space on a hinge
      (57,000) takes 20,000 lines in place of 83,000, its gradient 96,000 in place of 142,000: ready in 7 s in place of 14, and in 25 in
      place of 38, in 1.8 and 3.1 ms, 15 and 23; two such bodies 11 and 27 s, 5.9 and 8.3 ms; the gradient of Andrews' mechanism by Radau
      (64,000) 24 and 43 s, both 112 ms. A double pendulum (4,800) is faster by a fifth with all in one.
    - `loop_cost`: a loop over an array takes about as many instructions as this many entries do.
    """

    carried: int = 24
    few: int = 8
    in_registers: int = 512
    folded: int = 4096
    per_turn: int = 4
    vectors: tuple[int, ...] = (8, 4)
    stack_bytes: int = 1024
    heap_bytes: int = 2**30
    thread_bytes: int = 2**12
    fused_depth: int = 40
    vectorised: int = 12
    long_loop: int = 256
    written_out: int = 200
    numbers_written_out: int = 1000
    turns_written_out: int = 8000
    compaction: int = 2
    matrix_written_out: int = 6
    triangle_written_out: int = 7
    largest_matrix: int = 32
    longest_sort: int = 256
    instructions: int = 1_000_000
    ptx_lines: int = 20_000
    overestimate: int = 4
    whole: int = 15_000
    procedure: int = 100
    loop_cost: int = 12


THRESHOLDS = Thresholds()
