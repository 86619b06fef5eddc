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

/// Makes the mode the standard one for as long as nobody changes it. Returns what it was, for
/// restore_mode; 0 if it was that one.
inline std::uint64_t enter_standard_mode() {
#if defined(__SSE2__)
    constexpr unsigned standard = 0x1f80, flags = 0x3f;
    const unsigned before = _mm_getcsr() & ~flags;
    if (before == standard) return 0;
    _mm_setcsr(standard);
    return before | 1;  // a flag, so that no mode is 0
#elif defined(__aarch64__)
    std::uint64_t before;
    asm volatile("mrs %0, fpcr" : "=r"(before));
    if (before != 0) asm volatile("msr fpcr, %0" : : "r"(std::uint64_t{0}));
    return before;
#else
    return 0;
#endif
}

inline void restore_mode(std::uint64_t mode) {
#if defined(__SSE2__)
    _mm_setcsr(static_cast<unsigned>(mode) & ~1u);
#elif defined(__aarch64__)
    asm volatile("msr fpcr, %0" : : "r"(mode));
#else
    static_cast<void>(mode);
#endif
}

}  // namespace holdfast
