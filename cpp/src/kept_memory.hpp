// Memory that is kept for the next decision.
//
// A decision with a thousand particles fills some hundred kilobytes anew each time. Given back to
// the system in between, each page of them costs a fault, a tenth of the decision in all. So blocks
// of up to a megabyte wait here for whoever needs one of that size next, 16 MB at most.

#pragma once

#include <array>
#include <atomic>
#include <bit>
#include <cstddef>
#include <new>
#include <vector>

namespace holdfast {

class KeptMemory {
  public:
    static void* take(std::size_t bytes) {
        if (bytes < smallest || bytes > largest) return ::operator new(bytes);
        for (std::atomic<void*>& place : places_for(bytes)) {
            if (place.load(std::memory_order_relaxed) == nullptr) continue;
            if (void* block = place.exchange(nullptr, std::memory_order_acquire)) return block;
        }
        return ::operator new(std::bit_ceil(bytes));
    }

    static void give_back(void* block, std::size_t bytes) {
        if (bytes >= smallest && bytes <= largest) {
            for (std::atomic<void*>& place : places_for(bytes)) {
                void* empty = nullptr;
                if (place.compare_exchange_strong(empty, block, std::memory_order_release,
                                                  std::memory_order_relaxed)) {
                    return;
                }
            }
        }
        ::operator delete(block);
    }

  private:
    static constexpr std::size_t smallest = std::size_t{1} << 14, largest = std::size_t{1} << 20;
    static constexpr std::size_t sizes = std::bit_width(largest) - std::bit_width(smallest) + 1;
    using Places = std::array<std::atomic<void*>, 8>;

    // No lock: a process may be forked while another thread is here.
    static Places& places_for(std::size_t bytes) {
        static constinit std::array<Places, sizes> places{};
        const auto width = static_cast<std::size_t>(std::bit_width(std::bit_ceil(bytes)));
        return places[width - static_cast<std::size_t>(std::bit_width(smallest))];
    }
};

template <class T>
struct KeptAllocator {
    using value_type = T;
    KeptAllocator() = default;
    template <class U>
    KeptAllocator(const KeptAllocator<U>&) {}

    T* allocate(std::size_t n) { return static_cast<T*>(KeptMemory::take(n * sizeof(T))); }
    void deallocate(T* block, std::size_t n) { KeptMemory::give_back(block, n * sizeof(T)); }
    friend bool operator==(const KeptAllocator&, const KeptAllocator&) { return true; }
};

/// A vector whose memory is kept.
template <class T>
using KeptVector = std::vector<T, KeptAllocator<T>>;

}  // namespace holdfast
