// How many threads a call uses: no more than asked for, than there are, or than its work is worth.

#pragma once

#include <cstddef>

#ifdef _OPENMP
#include <omp.h>
#endif

namespace holdfast {

inline int thread_limit(int asked) {
#ifdef _OPENMP
    const int there_are = omp_get_max_threads();
    return asked <= 0 || asked > there_are ? there_are : asked;
#else
    (void)asked;
    return 1;
#endif
}

/// `work` in nanoseconds, roughly; waking another thread costs about ten microseconds.
inline int threads_for(double work, std::size_t tasks, int asked) {
    constexpr double worth_a_thread = 40e3;
    int threads = thread_limit(asked);
    if (work < 2 * worth_a_thread) return 1;
    const auto worth = static_cast<int>(work / worth_a_thread < 1024 ? work / worth_a_thread : 1024);
    if (worth < threads) threads = worth;
    if (tasks < static_cast<std::size_t>(threads)) threads = static_cast<int>(tasks);
    return threads < 1 ? 1 : threads;
}

inline int thread_number() {
#ifdef _OPENMP
    return omp_get_thread_num();
#else
    return 0;
#endif
}

}  // namespace holdfast
