// What the files of this folder share.

#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <initializer_list>

#include "philox.hpp"
#include "rounding.hpp"

namespace holdfast {

void bind_numerics(nanobind::module_& module);
void bind_entropy(nanobind::module_& module);
void bind_geometry(nanobind::module_& module);

}  // namespace holdfast

namespace holdfast::bindings {

template <std::size_t rank>
using Input = nanobind::ndarray<const double, nanobind::ndim<rank>, nanobind::c_contig,
                                nanobind::device::cpu>;

template <class Value>
using Output = nanobind::ndarray<nanobind::numpy, Value>;

/// A new NumPy array; `data` points to its uninitialised values.
template <class Value>
Output<Value> make_array(std::initializer_list<std::size_t> shape, Value*& data) {
    std::size_t count = 1;
    for (const std::size_t extent : shape) count *= extent;
    data = new Value[count];
    nanobind::capsule owner(data, [](void* p) noexcept { delete[] static_cast<Value*>(p); });
    return Output<Value>(data, shape, owner);
}

/// Adds a function to the module; all run in the standard floating-point mode.
template <class Function>
void define(nanobind::module_& module, const char* name, Function&& function) {
    module.def(name, static_cast<Function&&>(function), nanobind::call_guard<StandardRounding>());
}

using StreamWords = std::array<std::uint32_t, 5>;

inline Stream to_stream(const StreamWords& words) {
    return {words[0], words[1], words[2], words[3], words[4]};
}

}  // namespace holdfast::bindings
