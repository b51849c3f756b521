/* What the arithmetic needs of the compiler. Every C file that computes with doubles includes this first.
 *
 * A build that would round otherwise, or drop NaN, by which a value that is missing is known, stops here. */
#ifndef AERO_FLOAT_H
#define AERO_FLOAT_H

#include <float.h>

#if defined __FAST_MATH__ || defined __ASSOCIATIVE_MATH__ || defined __RECIPROCAL_MATH__ || \
    defined __NO_SIGNED_ZEROS__ || (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__)
#error "compile without -ffast-math, -Ofast and their parts: an invalid measurement would give a valid command"
#endif
#if FLT_EVAL_METHOD < 0 || FLT_EVAL_METHOD == 2
#error "doubles must be computed as doubles: on x86 compile with -mfpmath=sse -msse2, as the x87 rounds twice"
#endif
#if FLT_RADIX != 2 || DBL_MANT_DIG != 53 || DBL_MAX_EXP != 1024
#error "double must be IEEE 754 binary64: compile with doubles of 64 bits"
#endif

/* No multiplication and addition in one rounding. gcc 12's vectorizer makes such pairs (vfmaddsub) in spite of
 * -ffp-contract=off. clang with -ffp-contract=fast ignores its pragma; no macro tells, but `make test` does. */
#if defined __clang__
#pragma STDC FP_CONTRACT OFF
#elif defined __GNUC__
#pragma GCC optimize("fp-contract=off", "no-tree-slp-vectorize")
#endif

#endif
