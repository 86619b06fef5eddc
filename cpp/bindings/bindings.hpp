// What the files of this folder share.

#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <stdexcept>
#include <thread>

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

/// An array of the caller, for results: NumPy makes a small array faster than nanobind does.
template <class Value, std::size_t rank>
using InPlace =
    nanobind::ndarray<Value, nanobind::ndim<rank>, nanobind::c_contig, nanobind::device::cpu>;

inline void require(bool condition, const char* message) {
    if (!condition) throw std::invalid_argument(message);
}

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

/// Lets other Python threads run while it lives.
///
/// When the interpreter has begun to end, Python up to 3.13 ends a thread that asks for it back, by
/// unwinding its stack, which aborts the process at the first noexcept function on the way. Nobody
/// can ask beforehand whether that will happen: it may begin while the thread waits its turn. So a
/// thread that is being unwound (a daemon, since the others have been joined) stops right here, and
/// sleeps until the process has ended, as Python 3.14 does of itself.
class WithoutInterpreter {
  public:
    WithoutInterpreter() : state_(PyEval_SaveThread()) {}
    ~WithoutInterpreter() {
        try {
            PyEval_RestoreThread(state_);
        } catch (...) {
            for (;;) std::this_thread::sleep_for(std::chrono::hours(1));
        }
    }
    WithoutInterpreter(const WithoutInterpreter&) = delete;
    WithoutInterpreter& operator=(const WithoutInterpreter&) = delete;

  private:
    PyThreadState* state_;
};

/// Adds a function to the module; all run in the standard floating-point mode.
template <class Function, class... Extra>
void define(nanobind::module_& module, const char* name, Function&& function,
            const Extra&... extra) {
    module.def(name, static_cast<Function&&>(function), nanobind::call_guard<StandardRounding>(),
               extra...);
}

using StreamWords = std::array<std::uint32_t, 5>;

inline Stream to_stream(const StreamWords& words) {
    return {words[0], words[1], words[2], words[3], words[4]};
}

}  // namespace holdfast::bindings
