#include "controller.hpp"

#include <ATen/Parallel.h>
#include <ATen/Version.h>
#include <ATen/core/grad_mode.h>
#include <ATen/ops/from_blob.h>
#include <ATen/ops/full.h>
#include <ATen/ops/zeros.h>
#include <caffe2/serialize/inline_container.h>
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>
#include <torch/csrc/jit/api/module.h>
#include <torch/csrc/jit/runtime/graph_executor.h>
#include <torch/csrc/jit/serialization/import.h>
#include <torch/version.h>

#include <sys/utsname.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <map>
#include <optional>
#include <sstream>
#include <stdexcept>

#include "record.hpp"

namespace {

const char* const kFormat = "nsde_torch controller/2";
const char* const kRecord = "extra/nsde.json";
using Tensors = std::vector<at::Tensor>;

std::string series(const std::string& version) {  // "2.13.0+cpu" -> "2.13"
    size_t first = version.find('.');
    return version.substr(0, version.find_first_not_of("0123456789", first + 1));
}

std::vector<std::string> words(const Json& list) {
    std::vector<std::string> out;
    for (const auto& item : list.items) out.push_back(item.text);
    return out;
}

std::string processor() {  // as nsde_torch/export/record.py says it: "Linux x86_64 AVX512"
    utsname own{};
    uname(&own);
    return std::string(own.sysname) + " " + own.machine + " " + at::get_cpu_capability();
}

// The record of a file whose content hashes to what the record says.
Json checked(const std::string& file) {
    std::map<std::string, std::string> members;
    try {
        caffe2::serialize::PyTorchStreamReader reader(file);
        for (const auto& name : reader.getAllRecords()) {
            auto [data, size] = reader.getRecord(name);
            members[name] = std::string(static_cast<const char*>(data.get()), size);
        }
    } catch (const std::exception& error) {
        throw std::runtime_error(file + " is missing, truncated or damaged");
    }
    if (!members.count(kRecord)) throw std::runtime_error(file + " is no exported controller");
    Json record = parse_json(members[kRecord]);
    if (record.at("format").text != kFormat)
        throw std::runtime_error(file + " is of the format " + record.at("format").text + "; this program reads " + kFormat);
    for (const char* name : {"sha256", "written"}) {  // the record is hashed without its own hash, and without the time
        std::string& text = members[kRecord];
        const std::string key = std::string("\n \"") + name + "\": \"";
        const size_t at = text.find(key);
        if (at != std::string::npos) text.erase(at + key.size(), text.find('"', at + key.size()) - at - key.size());
    }
    Sha256 digest;
    for (const auto& [name, content] : members) {
        for (const std::string* part : {&name, &content}) {
            uint64_t n = part->size();
            uint8_t length[8];
            for (int i = 0; i < 8; ++i) length[i] = static_cast<uint8_t>(n >> (8 * i));
            digest.add(length, 8);
            digest.add(part->data(), part->size());
        }
    }
    if (digest.hex() != record.at("sha256").text) throw std::runtime_error(file + " was changed after it was written");
    const std::string& version = record.at("versions").at("torch").text;
    if (series(version) != series(TORCH_VERSION))
        throw std::runtime_error(file + " was written with torch " + version + ", and this is libtorch " + TORCH_VERSION);
    if (record.at("kind").text == "aoti" && record.at("processor").text != processor())
        throw std::runtime_error(file + " was compiled for " + record.at("processor").text + ", and this is " + processor());
    return record;
}

at::Tensor tensor(const std::vector<double>& numbers, std::vector<int64_t> shape) {
    return at::from_blob(const_cast<double*>(numbers.data()), shape, at::kDouble);  // lives as long as `numbers`
}

at::Tensor scalar(const double& number) { return at::from_blob(const_cast<double*>(&number), {}, at::kDouble); }

std::vector<double> numbers(const at::Tensor& t) {
    at::Tensor own = t.contiguous();
    return {own.const_data_ptr<double>(), own.const_data_ptr<double>() + own.numel()};
}

}  // namespace

struct Controller::Loaded {
    std::optional<torch::jit::Module> script;
    std::map<std::string, std::unique_ptr<torch::inductor::AOTIModelPackageLoader>> stages;
    int changes = 0, iterations = 0;
    double left = 0.0, tolerance = 0.0;

    Tensors call(const char* name, const Tensors& arguments) {
        [[maybe_unused]] static thread_local const bool alone = (at::set_num_threads(1), true);  // counted by thread
        c10::InferenceMode guard;
        if (!script) return std::strcmp(name, "step") == 0 ? step(arguments) : stages.at(name)->run(arguments);
        // to specialise a graph at its first calls takes a second and makes it no faster
        torch::jit::GraphOptimizerEnabledGuard plain(false);
        std::vector<c10::IValue> given(arguments.begin(), arguments.end());
        Tensors out;
        c10::IValue result = script->get_method(name)(given);
        for (const auto& item : result.toTupleRef().elements()) out.push_back(item.toTensor());
        return out;
    }

    // The loops between the compiled stages: nsde_torch/export/step.py, `run`. In a TorchScript file they are in the file.
    Tensors step(const Tensors& given) {
        auto run = [this](const char* name, const Tensors& arguments) { return stages.at(name)->run(arguments); };
        Tensors begun = run("begin", given);
        const at::Tensor &z0 = begun[0], &ref = begun[3], &last = begun[4], &d = begun[5], &head = begun[6];
        at::Tensor u = begun[1], z = begun[2], cost = at::full({1}, INFINITY, u.options()), gap = cost;
        int done = 0;
        if (number(begun[7]) < 0.5) {
            const at::Tensor no_step = at::zeros({1, u.numel()}, u.options());
            if (number(head) < 0.5) z = run("finish", {z0, u, ref, last, d, no_step, at::zeros({1}, u.options())})[1];
            for (bool going = true; going; going = done < iterations && !(number(gap) <= tolerance)) {
                Tensors q = run("prepare", {z0, u, z, ref, last, d});
                Tensors state{no_step, q[1], q[5], q[6]};
                for (int k = 0; k < changes; ++k) {
                    state = run("active_set", {q[0], q[1], q[2], q[3], q[4], state[0], state[1], state[2], state[3]});
                    if (number(state[4]) <= left) break;
                }
                Tensors best = run("finish", {z0, u, ref, last, d, state[2], state[3]});
                u = best[0], z = best[1], cost = best[2], gap = best[3];
                ++done;
            }
        }
        at::Tensor count = at::full({}, static_cast<double>(done), at::kDouble);
        return run("end", {u, z, cost, gap, count, z0, begun[1], begun[2], head, begun[7]});
    }

    static double number(const at::Tensor& t) { return t.scalar_type() == at::kDouble ? *t.const_data_ptr<double>() : *t.const_data_ptr<float>(); }
};

Controller::~Controller() = default;

Controller::Controller(const std::string& file) : loaded_(std::make_unique<Loaded>()) {
    Json record = checked(file);
    const Json& s = record.at("sizes");
    auto size = [&](const char* name) { return static_cast<int>(s.at(name).number); };
    sizes = {size("nx"), size("nu"), size("nz"), size("nd"), size("steps"), 0};
    sizes.n_plan = static_cast<int>(record.at("step").at("inputs").items.back().at("shape").items.at(0).number);
    if (record.at("loops").at("anew").number > 0) throw std::runtime_error(file + " is of no multirotor: this program flies them alone");
    period = record.at("period_s").number;
    sample = record.at("sample_s").number;
    dt = record.at("step_s").number;
    latency = record.at("latency_s").number;
    keep = record.at("safety").at("keep").number;
    for (const auto& item : record.at("hover").items) hover.push_back(item.number);
    status = words(record.at("status"));
    state_names = words(record.at("state_names"));
    input_names = words(record.at("input_names"));
    const std::string& kind = record.at("kind").text;
    about = kind + ", " + record.at("dtype").text + ", sha256 " + record.at("sha256").text.substr(0, 16) + "..., model " +
            record.at("model").at("weights_sha256").text.substr(0, 16) + "..., torch " +
            record.at("versions").at("torch").text + ", written " + record.at("written").text;
    try {
        if (kind == "torchscript") {
            loaded_->script = torch::jit::load(file, at::kCPU);
        } else if (kind == "aoti") {
            for (const char* name : {"begin", "prepare", "active_set", "finish", "end", "predict"})
                loaded_->stages[name] = std::make_unique<torch::inductor::AOTIModelPackageLoader>(file, name, true);
            const Json& loops = record.at("loops");
            loaded_->changes = static_cast<int>(loops.at("changes").number);
            loaded_->iterations = static_cast<int>(loops.at("iterations").number);
            loaded_->left = loops.at("left").number;
            loaded_->tolerance = loops.at("tolerance").number;
        } else {
            throw std::runtime_error("its kind " + kind + " is unknown");
        }
    } catch (const std::exception& error) {
        throw std::runtime_error(file + " cannot be loaded: " + error.what());
    }
}

Plan Controller::step(const std::vector<double>& state, bool valid, double elapsed, const std::vector<double>& reference,
                      const std::vector<double>& last, const std::vector<double>& before) {
    const double nan = std::numeric_limits<double>::quiet_NaN();
    std::vector<double> none(sizes.n_plan, 0.0), push(sizes.nd, 0.0), memory(sizes.nz - sizes.nx, nan);
    std::vector<double> x(state.begin(), state.begin() + sizes.nx), unknown(sizes.nu, nan);
    if (static_cast<int>(state.size()) == sizes.nz) memory.assign(state.begin() + sizes.nx, state.end());
    const double sound = valid ? 1.0 : 0.0;
    Tensors out = loaded_->call(
        "step", {tensor(x, {sizes.nx}), scalar(sound), scalar(elapsed), tensor(reference, {sizes.steps, sizes.nx}),
                 tensor(last.empty() ? unknown : last, {sizes.nu}), tensor(push, {sizes.nd}),
                 tensor(memory, {sizes.nz - sizes.nx}), tensor(before.empty() ? none : before, {sizes.n_plan})});
    Plan plan;
    plan.inputs = numbers(out[0]);
    plan.rates = numbers(out[1]);
    plan.thrust = out[2].item<double>();
    plan.cost = out[5].item<double>();
    plan.status = std::clamp(static_cast<int>(out[7].item<double>()), 0, static_cast<int>(status.size()) - 1);
    plan.iterations = static_cast<int>(out[8].item<double>());
    plan.after = numbers(out[9]);
    return plan;
}

std::vector<double> Controller::predict(const std::vector<double>& z, const std::vector<double>& u) {
    std::vector<double> push(sizes.nd, 0.0);
    return numbers(loaded_->call("predict", {tensor(z, {sizes.nz}), tensor(u, {sizes.nu}), tensor(push, {sizes.nd})})[0]);
}
