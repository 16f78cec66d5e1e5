// An exported controller (TorchScript or an AOTInductor package) behind plain numbers; libtorch is seen nowhere else.
#pragma once

#include <memory>
#include <string>
#include <vector>

struct Plan {
    std::vector<double> inputs;  // steps * nu, row by row
    std::vector<double> rates;   // 3 [rad/s], FLU
    double thrust = 0.0;         // mean of the first commands
    double cost = 0.0;
    int status = 0;
    int iterations = 0;
    std::vector<double> after;   // for the next step
};

struct Sizes {
    int nx = 0, nu = 0, nz = 0, nd = 0, steps = 0, n_plan = 0;
};

class Controller {
public:
    // Reads, checks (format, hash, versions) and then loads; throws std::runtime_error with the reason.
    explicit Controller(const std::string& file);
    ~Controller();

    // The controller's step; see the record for units and frames. `before` is empty at first.
    Plan step(const std::vector<double>& state, bool valid, double elapsed, const std::vector<double>& reference,
              const std::vector<double>& last, const std::vector<double>& before);

    // The state one sample later under inputs that act.
    std::vector<double> predict(const std::vector<double>& z, const std::vector<double>& u);

    Sizes sizes;
    double period = 0.0, sample = 0.0, dt = 0.0, latency = 0.0, keep = 0.0;
    std::vector<double> hover;
    std::vector<std::string> status, state_names, input_names;
    std::string about;  // kind, hash and versions in a line

private:
    struct Loaded;
    std::unique_ptr<Loaded> loaded_;
};
