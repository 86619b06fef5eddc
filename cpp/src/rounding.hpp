// The floating-point mode that all results are computed in, whatever the caller's.
//
// Some libraries make the processor flush subnormal numbers to zero, for the whole thread that
// loads them. Results must not depend on that, nor on which thread computes them.

#pragma once

#include <cstdint>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace holdfast {

/// While it lives: round to nearest, subnormal numbers as they are, no traps.
class StandardRounding {
  public:
#if defined(__SSE2__)
    StandardRounding() : before_(_mm_getcsr()) { _mm_setcsr(0x1f80); }
    ~StandardRounding() { _mm_setcsr(before_); }

  private:
    unsigned before_;
#elif defined(__aarch64__)
    StandardRounding() {
        asm volatile("mrs %0, fpcr" : "=r"(before_));
        asm volatile("msr fpcr, %0" : : "r"(std::uint64_t{0}));
    }
    ~StandardRounding() { asm volatile("msr fpcr, %0" : : "r"(before_)); }

  private:
    std::uint64_t before_;
#else
    StandardRounding() {}
    ~StandardRounding() {}
#endif

  public:
    StandardRounding(const StandardRounding&) = delete;
    StandardRounding& operator=(const StandardRounding&) = delete;
};

}  // namespace holdfast
