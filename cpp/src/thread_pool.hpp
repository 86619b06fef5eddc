// Work split over threads, without waiting for threads that do not come.
//
// A call offers its tasks to helper threads and works on them itself. It then waits only for tasks
// that a helper has begun, never for the helper itself: on a machine that is busy with other
// things, a helper that is not scheduled costs nothing; only one that is put aside in the middle of
// a task costs a time slice. (A fork-join team, as of OpenMP, ends with a barrier that every thread
// must reach; with one other busy process on two cores that made decisions ten times slower.)
//
// Results must not depend on which thread ran a task: tasks write to places of their own.

#pragma once

#include <cstddef>
#include <cstdint>
#include <exception>
#include <type_traits>

namespace holdfast {

/// Threads that a call may use: `asked`, or as many as there are processors for this process if 0.
int thread_limit(int asked);

/// How many threads are worth their waking for `work` nanoseconds in `tasks` parts.
int threads_for(double work, std::size_t tasks, int asked);

/// Sets the work in nanoseconds from which several threads are used; returns what it was. For
/// tests.
double use_threads_from(double nanoseconds);

/// Helper threads that exist. For tests.
int threads_started();

/// What `run_tasks` raises where the interruption of the calling thread has been set.
struct Interrupted : std::exception {
    const char* what() const noexcept override { return "nobody awaits this computation any more"; }
};

/// Sets the flag that ends what the calling thread computes, once it is not 0 any more; another
/// thread may set it to 1 at any time. Null for none. It becomes 2 once this thread has computed
/// for `most_s` seconds of its processor time, which goes on only while it has a processor.
void watch_interruption(std::uint8_t* flag, double most_s);

/// Whether that flag is set.
bool is_interrupted();

/// Raises Interrupted if that flag is set; for tasks that may take long.
void check_interruption();

/// Calls `function(context, i)` for every i < tasks; passes on the first exception.
void run_tasks(std::size_t tasks, int threads, void (*function)(void*, std::size_t), void* context);

template <class Body>
void parallel_for(std::size_t tasks, int threads, Body&& body) {
    using Plain = std::remove_reference_t<Body>;
    run_tasks(
        tasks, threads, [](void* context, std::size_t i) { (*static_cast<Plain*>(context))(i); },
        const_cast<void*>(static_cast<const void*>(&body)));
}

}  // namespace holdfast
