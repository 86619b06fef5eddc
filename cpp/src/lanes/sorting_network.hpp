// Sorting networks: the same comparisons whatever the data, so eight lists are sorted as one (one
// compilation per instruction set).

#pragma once

#include "lanes.hpp"

namespace holdfast::inline HOLDFAST_ISA {

template <std::size_t... i>
struct Indices {};
template <std::size_t count, std::size_t... i>
struct IndicesBelow : IndicesBelow<count - 1, count - 1, i...> {};
template <std::size_t... i>
struct IndicesBelow<0, i...> {
    using type = Indices<i...>;
};

/// Comparisons of a sorting network, as constants, so that the rows it sorts can stay in registers.
struct Comparison {
    std::uint8_t low, high;
};

template <std::size_t length>
struct Network {
    Comparison comparisons[length * 10];
    std::size_t size;
};

/// Batcher's odd-even merge sort (1968); `length` is a power of two.
template <std::size_t length>
constexpr Network<length> sorting_network() {
    Network<length> network{};
    for (std::size_t p = 1; p < length; p += p) {
        for (std::size_t k = p; k >= 1; k /= 2) {
            for (std::size_t j = k % p; j + k < length; j += 2 * k) {
                for (std::size_t i = j; i < j + k && i + k < length; ++i) {
                    if (i / (2 * p) != (i + k) / (2 * p)) continue;
                    network.comparisons[network.size++] = {static_cast<std::uint8_t>(i),
                                                           static_cast<std::uint8_t>(i + k)};
                }
            }
        }
    }
    return network;
}

/// The last stages of a bitonic sorter: sorts what first rises and then falls.
template <std::size_t length>
constexpr Network<length> merging_network() {
    Network<length> network{};
    for (std::size_t k = length / 2; k >= 1; k /= 2) {
        for (std::size_t j = 0; j < length; j += 2 * k) {
            for (std::size_t i = j; i < j + k; ++i) {
                network.comparisons[network.size++] = {static_cast<std::uint8_t>(i),
                                                       static_cast<std::uint8_t>(i + k)};
            }
        }
    }
    return network;
}

template <std::size_t length>
inline constexpr Network<length> sorting = sorting_network<length>();
template <std::size_t length>
inline constexpr Network<length> merging = merging_network<length>();

template <std::size_t length, const Network<length>& network, std::size_t... i>
HOLDFAST_INLINE void apply_written_out(Lanes* rows, Indices<i...>) {
    (order(rows[network.comparisons[i].low], rows[network.comparisons[i].high]), ...);
}

/// Applies a network to rows of eight lists each. Thirty-two rows fit into the registers of
/// AVX-512, so there the comparisons are written out; more rows go through memory in a loop.
template <std::size_t length, const Network<length>& network>
HOLDFAST_INLINE void apply(Lanes* rows) {
    if constexpr (length <= 32) {
        apply_written_out<length, network>(rows, typename IndicesBelow<network.size>::type{});
    } else {
        for (std::size_t i = 0; i < network.size; ++i) {
            order(rows[network.comparisons[i].low], rows[network.comparisons[i].high]);
        }
    }
}

}  // namespace holdfast::inline HOLDFAST_ISA
