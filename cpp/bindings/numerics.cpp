#include <nanobind/stl/array.h>

#include "bindings.hpp"
#include "deterministic_math.hpp"
#include "resampling.hpp"
#include "vector_kernels.hpp"

namespace nb = nanobind;
using namespace holdfast;
using namespace holdfast::bindings;

namespace {

using Elementwise = void (*)(const double*, double*, std::size_t);

template <Elementwise VectorKernels::* function>
Output<double> elementwise(const Input<1>& in) {
    double* out;
    auto result = make_array<double>({in.shape(0)}, out);
    (vector_kernels().*function)(in.data(), out, in.shape(0));
    return result;
}

}  // namespace

void holdfast::bind_numerics(nb::module_& module) {
    module.def("exp", &elementwise<&VectorKernels::exp>);
    module.def("log", &elementwise<&VectorKernels::log>);
    module.def("sin", &elementwise<&VectorKernels::sin>);
    module.def("cos", &elementwise<&VectorKernels::cos>);
    module.def("arcsin", [](double x) { return arcsin(x); });
    module.def("sum",
               [](const Input<1>& in) { return vector_kernels().sum(in.data(), in.shape(0)); });
    module.def("weighted_sums", [](const Input<1>& weights, const Input<2>& rows) {
        double* out;
        auto result = make_array<double>({rows.shape(1)}, out);
        vector_kernels().weighted_sums(weights.data(), rows.data(), rows.shape(0), rows.shape(1),
                                       out);
        return result;
    });
    module.def("normalize", [](const Input<1>& log_weights, bool drop_negligible) {
        double* out;
        auto result = make_array<double>({log_weights.shape(0)}, out);
        const std::size_t survivors = vector_kernels().normalize(
            log_weights.data(), log_weights.shape(0), drop_negligible, out);
        return nb::make_tuple(result, survivors);
    });
    module.def("philox", [](const StreamWords& words, std::uint32_t block) {
        const PhiloxBlock result = philox(to_stream(words), block);
        return StreamWords{result.words[0], result.words[1], result.words[2], result.words[3], 0};
    });
    module.def("substream", [](const StreamWords& words, std::uint32_t index) {
        const Stream s = substream(to_stream(words), index);
        return nb::make_tuple(s.key0, s.key1, s.c1, s.c2, s.c3);
    });
    module.def("normals", [](const StreamWords& words, std::size_t count) {
        double* out;
        auto result = make_array<double>({count}, out);
        normals(to_stream(words), 0, count, out);
        return result;
    });
    module.def("uniforms", [](const StreamWords& words, std::size_t count) {
        double* out;
        auto result = make_array<double>({count}, out);
        uniforms(to_stream(words), 0, count, out);
        return result;
    });
    module.def("systematic_resample", [](const Input<1>& weights, double offset) {
        std::int64_t* out;
        auto result = make_array<std::int64_t>({weights.shape(0)}, out);
        systematic_resample(weights.data(), weights.shape(0), offset, out);
        return result;
    });
}
