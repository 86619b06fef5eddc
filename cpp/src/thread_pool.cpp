#include "thread_pool.hpp"

#include <pthread.h>
#include <sched.h>
#include <time.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <condition_variable>
#include <cstdlib>
#include <exception>
#include <limits>
#include <memory>
#include <mutex>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "rounding.hpp"

namespace holdfast {

namespace {

constexpr int max_threads = 256;
/// How long a thread watches for what comes soon before it goes to sleep: about what waking costs.
/// It keeps its processor meanwhile: who yields it to a process that computes without pause gets it
/// back only after that one's time slice, while a sleeper is woken at once.
constexpr double patience = 30e-6;

constexpr std::uint8_t took_too_long = 2;

thread_local std::uint8_t* interruption = nullptr;
/// Until when the calling thread may compute, by its own processor time; and the earliest moment at
/// which that can be, because the monotonic clock is cheaper to read.
thread_local double ends_at = std::numeric_limits<double>::infinity();
thread_local double looked_at_from = std::numeric_limits<double>::infinity();

double seconds_of(clockid_t clock) {
    timespec time{};
    clock_gettime(clock, &time);
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

/// Waits until `happened()`, but no longer than the patience.
template <class Happened>
void watch_for(Happened&& happened) {
    const double until = seconds_of(CLOCK_MONOTONIC) + patience;
    do {
        for (int turn = 0; turn < 16; ++turn) {
            if (happened()) return;
#if defined(__x86_64__)
            __builtin_ia32_pause();
#elif defined(__aarch64__)
            asm volatile("yield");
#endif
        }
    } while (seconds_of(CLOCK_MONOTONIC) < until);
}

/// Sets the flag once the calling thread's time is used up; helpers have no limit of their own.
void look_at_the_clock(std::uint8_t* flag) {
    if (std::isinf(looked_at_from) || seconds_of(CLOCK_MONOTONIC) < looked_at_from) return;
    if (seconds_of(CLOCK_THREAD_CPUTIME_ID) < ends_at) return;
    std::uint8_t expected = 0;
    __atomic_compare_exchange_n(flag, &expected, took_too_long, false, __ATOMIC_RELAXED,
                                __ATOMIC_RELAXED);
}

bool must_end(std::uint8_t* flag) {
    if (flag == nullptr) return false;
    look_at_the_clock(flag);
    return __atomic_load_n(flag, __ATOMIC_RELAXED) != 0;
}

/// Raises Interrupted if a computation is to end.
void require_awaited(std::uint8_t* flag) {
    if (must_end(flag)) throw Interrupted();
}

/// One call's tasks. Helpers hold it by shared pointer: one that comes late finds nothing left to
/// do.
struct Job {
    void (*function)(void*, std::size_t);
    void* context;
    std::size_t tasks;
    std::atomic<std::size_t> next{0};
    std::atomic<std::size_t> finished{0};
    std::atomic<bool> failed{false};
    std::exception_ptr failure;
    std::uint8_t* interrupted = interruption;

    /// Works until no task is left; tells whether there was any.
    bool work() {
        std::size_t mine = 0;
        std::uint8_t* const before = std::exchange(interruption, interrupted);
        for (std::size_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < tasks; ++mine) {
            if (failed.load(std::memory_order_relaxed)) continue;
            try {
                require_awaited(interrupted);
                function(context, i);
            } catch (...) {
                if (!failed.exchange(true)) failure = std::current_exception();
            }
        }
        interruption = before;
        if (mine != 0) {
            finished.fetch_add(mine, std::memory_order_release);
            finished.notify_one();
        }
        return mine != 0;
    }
};

class Pool {
  public:
    void run(std::size_t tasks, int threads, void (*function)(void*, std::size_t), void* context) {
        const auto job = std::make_shared<Job>();
        job->function = function;
        job->context = context;
        job->tasks = tasks;
        {
            const std::lock_guard lock(mutex_);
            add_helpers(threads - 1);
            job_ = job;
            wanted_ = threads - 1;
            generation_.fetch_add(1, std::memory_order_release);
        }
        for (int i = 1; i < threads; ++i) wake_.notify_one();
        job->work();
        // A task that a helper has begun: soon done, unless the helper was put aside in the middle.
        const auto finished = [&] { return job->finished.load(std::memory_order_acquire); };
        watch_for([&] { return finished() == tasks; });
        for (std::size_t so_far; (so_far = finished()) < tasks;) {
            job->finished.wait(so_far, std::memory_order_acquire);
        }
        {
            // Another caller's job may have taken the place already.
            const std::lock_guard lock(mutex_);
            if (job_ == job) job_.reset();
        }
        if (job->failed.load()) std::rethrow_exception(job->failure);
    }

    int helpers() {
        const std::lock_guard lock(mutex_);
        return helpers_;
    }

  private:
    void add_helpers(int number) {
        while (static_cast<int>(helpers_) < std::min(number, max_threads)) {
            try {
                std::thread([this] { help(); }).detach();
            } catch (const std::system_error&) {
                return;  // the system has no more threads: those that are there do the work
            }
            ++helpers_;
        }
    }

    void help() {
        const StandardRounding standard_rounding;
        std::size_t seen = 0;
        bool worked = false;
        for (;;) {
            // Whoever has just worked may soon be wanted again.
            if (worked)
                watch_for([&] { return generation_.load(std::memory_order_acquire) != seen; });
            std::shared_ptr<Job> job;
            {
                std::unique_lock lock(mutex_);
                wake_.wait(lock, [&] { return generation_.load() != seen; });
                seen = generation_.load();
                if (wanted_ > 0) {
                    --wanted_;
                    job = job_;
                }
            }
            worked = job && job->work();
        }
    }

    std::mutex mutex_;
    std::condition_variable wake_;
    std::shared_ptr<Job> job_;
    int wanted_ = 0;  // helpers that may still join the current job
    std::atomic<std::size_t> generation_{0};
    int helpers_ = 0;
};

// Never destroyed: helpers sleep in it until the process ends. After a fork the child has no
// helpers, so it starts with a new pool; the old one's mutex may be held by a thread that is not
// there any more.
std::atomic<Pool*> the_pool{nullptr};

Pool& pool() {
    static const int registered = pthread_atfork(
        nullptr, nullptr, [] { the_pool.store(nullptr, std::memory_order_relaxed); });
    (void)registered;
    Pool* current = the_pool.load(std::memory_order_acquire);
    if (current == nullptr) {
        auto fresh = std::make_unique<Pool>();
        if (the_pool.compare_exchange_strong(current, fresh.get())) current = fresh.release();
    }
    return *current;
}

/// Work in nanoseconds that is worth a second thread; waking it takes its share of this.
std::atomic<double> threads_from{120e3};

/// As many as this process may run on, or fewer by the variable that all numerical libraries heed.
int processors() {
    if (const char* asked = std::getenv("OMP_NUM_THREADS")) {
        const int number = std::atoi(asked);
        if (number > 0) return number;
    }
#if defined(__linux__)
    cpu_set_t set;
    if (sched_getaffinity(0, sizeof set, &set) == 0) return std::max(1, CPU_COUNT(&set));
#endif
    return std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
}

}  // namespace

int thread_limit(int asked) {
    static const int there_are = std::min(processors(), max_threads);
    return asked <= 0 || asked > there_are ? there_are : asked;
}

double use_threads_from(double nanoseconds) {
    return threads_from.exchange(nanoseconds);
}

void watch_interruption(std::uint8_t* flag, double most_s) {
    interruption = flag;
    looked_at_from = ends_at = most_s;
    if (std::isinf(most_s)) return;
    ends_at += seconds_of(CLOCK_THREAD_CPUTIME_ID);
    looked_at_from += seconds_of(CLOCK_MONOTONIC);
}

bool is_interrupted() {
    return must_end(interruption);
}

void check_interruption() {
    require_awaited(interruption);
}

int threads_started() {
    return pool().helpers();
}

int threads_for(double work, std::size_t tasks, int asked) {
    const double from = threads_from.load(std::memory_order_relaxed);
    if (work < from) return 1;
    const double worth = std::min(2.0 * work / (from + 1.0), static_cast<double>(tasks));
    return std::max(1, static_cast<int>(std::min(worth, static_cast<double>(thread_limit(asked)))));
}

void run_tasks(std::size_t tasks, int threads, void (*function)(void*, std::size_t),
               void* context) {
    if (threads <= 1 || tasks <= 1) {
        for (std::size_t i = 0; i < tasks; ++i) {
            require_awaited(interruption);
            function(context, i);
        }
        return;
    }
    pool().run(tasks, threads, function, context);
}

}  // namespace holdfast
