// Flies an exported controller: states in at a fixed rate, motor commands out, safe when something is late or wrong.
//
//   flight_computer --controller controller.ts --reference reference.csv --log flight_0.csv --out inputs.csv
//   flight_computer --controller controller.pt2 --reference reference.csv --udp 14600 --reply 127.0.0.1:14601 --seconds 30
//
// States come from a recorded log (as fast as it goes, or with --realtime at its own pace) or as UDP datagrams of doubles
// (time, then the state; little-endian). The controller runs in a thread of its own, so that the loop keeps its rate:
//
//   solved in time                  the new plan's first commands
//   late, failed, or a bad state    the last plan, shifted by its age, for as long as the controller keeps one
//   older than that, or none        hover
//
// What came of each period is a row of --out; percentiles are printed at the end.

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "controller.hpp"
#include "series.hpp"

namespace {

using Clock = std::chrono::steady_clock;
using Numbers = std::vector<double>;

struct Options {
    std::string controller, reference, log, out, reply;
    int udp = 0;
    double rate = 0.0, deadline = 0.0, seconds = 0.0, start = 0.0;
    int late = -1;  // a period whose solve is made late on purpose, for tests
    bool realtime = false;
};

const char* const kUsage =
    "flight_computer --controller FILE --reference CSV (--log CSV [--realtime] | --udp PORT [--reply HOST:PORT] --seconds S)\n"
    "  [--out CSV] [--rate HZ: the file's] [--deadline MS: 0.8 of a period] [--start S: time in the reference] [--make-late K]";

Options parsed(int count, char** words) {
    Options o;
    std::map<std::string, std::string*> texts{{"--controller", &o.controller}, {"--reference", &o.reference},
                                              {"--log", &o.log},               {"--out", &o.out},
                                              {"--reply", &o.reply}};
    std::map<std::string, double*> values{
        {"--rate", &o.rate}, {"--deadline", &o.deadline}, {"--seconds", &o.seconds}, {"--start", &o.start}};
    for (int k = 1; k < count; ++k) {
        std::string word = words[k];
        if (word == "--realtime") {
            o.realtime = true;
            continue;
        }
        if (k + 1 >= count) throw std::runtime_error("what is " + word + "?\n" + kUsage);
        if (texts.count(word)) *texts[word] = words[++k];
        else if (values.count(word)) *values[word] = std::stod(words[++k]);
        else if (word == "--udp") o.udp = std::stoi(words[++k]);
        else if (word == "--make-late") o.late = std::stoi(words[++k]);
        else throw std::runtime_error("what is " + word + "?\n" + kUsage);
    }
    if (o.controller.empty() || o.reference.empty() || (o.log.empty() == (o.udp == 0))) throw std::runtime_error(kUsage);
    if (o.udp && !(o.seconds > 0)) throw std::runtime_error("--udp needs --seconds");
    return o;
}

// The newest state that has come by UDP.
class Receiver {
public:
    Receiver(int port, int columns) : columns_(columns), socket_(::socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK, 0)) {
        sockaddr_in own{};
        own.sin_family = AF_INET;
        own.sin_port = htons(static_cast<uint16_t>(port));
        own.sin_addr.s_addr = htonl(INADDR_LOOPBACK);  // whoever can send states flies the machine
        if (socket_ < 0 || ::bind(socket_, reinterpret_cast<sockaddr*>(&own), sizeof own) != 0)
            throw std::runtime_error("UDP port " + std::to_string(port) + " cannot be opened");
    }
    ~Receiver() { ::close(socket_); }

    // Takes what has come; true if a state is younger than a period.
    bool newest(Numbers& state) {
        std::vector<double> buffer(columns_ + 2);
        bool fresh = false;
        for (ssize_t n; (n = ::recv(socket_, buffer.data(), buffer.size() * sizeof(double), 0)) >= 0;) {
            if (n != static_cast<ssize_t>((columns_ + 1) * sizeof(double))) continue;
            if (!(buffer[0] > last_)) continue;  // older than what is known, or no number
            last_ = buffer[0];
            state.assign(buffer.begin() + 1, buffer.begin() + 1 + columns_);
            fresh = true;
        }
        return fresh;
    }

    void send(const std::string& to, const Numbers& inputs) const {
        size_t colon = to.rfind(':');
        sockaddr_in other{};
        other.sin_family = AF_INET;
        other.sin_port = htons(static_cast<uint16_t>(std::stoi(to.substr(colon + 1))));
        if (::inet_pton(AF_INET, to.substr(0, colon).c_str(), &other.sin_addr) != 1) return;
        (void)::sendto(socket_, inputs.data(), inputs.size() * sizeof(double), 0, reinterpret_cast<sockaddr*>(&other),
                       sizeof other);
    }

private:
    int columns_, socket_;
    double last_ = -1e300;
};

struct Job {
    Numbers state, reference, last;
    bool valid = true;
    double time = 0.0;  // when the plan's first commands act
    bool hold = false;  // made late on purpose
};

struct Result {
    Plan plan;
    double time = 0.0, milliseconds = 0.0;
};

// Solves in a thread of its own, one job at a time; keeps the plan before.
class Solver {
public:
    explicit Solver(Controller& controller) : controller_(controller), thread_([this] { run(); }) {}
    ~Solver() {
        {
            std::lock_guard lock(mutex_);
            stop_ = true;
        }
        wake_.notify_all();
        thread_.join();
    }

    // False if the job before is not done yet.
    bool give(Job job) {
        std::lock_guard lock(mutex_);
        if (job_) return false;
        job_ = std::move(job);
        wake_.notify_all();
        return true;
    }

    // A result, if there is one by then.
    std::optional<Result> wait(std::optional<Clock::time_point> until) {
        std::unique_lock lock(mutex_);
        auto done = [this] { return result_.has_value() || (!job_ && failed_); };
        if (until) wake_.wait_until(lock, *until, done);
        else wake_.wait(lock, done);
        failed_ = false;
        std::optional<Result> out;
        out.swap(result_);
        return out;
    }

private:
    void run() {
        std::unique_lock lock(mutex_);
        while (true) {
            wake_.wait(lock, [this] { return stop_ || (job_ && !result_); });
            if (stop_) return;
            Job job = *job_;
            lock.unlock();
            std::optional<Result> out;
            try {
                if (job.hold) std::this_thread::sleep_for(std::chrono::milliseconds(200));
                auto began = Clock::now();
                double elapsed = before_.empty() ? 0.0 : job.time - time_;
                Plan plan = controller_.step(job.state, job.valid, elapsed, job.reference, job.last, before_);
                before_ = plan.after;
                time_ = job.time;
                double took = std::chrono::duration<double, std::milli>(Clock::now() - began).count();
                out = Result{std::move(plan), job.time, took};
            } catch (const std::exception& error) {
                std::cerr << "step failed: " << error.what() << "\n";
                before_.clear();  // begin anew
            }
            lock.lock();
            failed_ = !out;
            result_ = std::move(out);
            job_.reset();
            wake_.notify_all();
        }
    }

    Controller& controller_;
    std::mutex mutex_;
    std::condition_variable wake_;
    std::optional<Job> job_;
    std::optional<Result> result_;
    bool stop_ = false, failed_ = false;
    Numbers before_;
    double time_ = 0.0;
    std::thread thread_;
};

std::string percentiles(Numbers values) {
    if (values.empty()) return "none";
    std::sort(values.begin(), values.end());
    std::ostringstream out;
    out << std::fixed << std::setprecision(2);
    for (double p : {50.0, 90.0, 99.0, 99.9}) {
        double at = p / 100.0 * (values.size() - 1);
        size_t k = static_cast<size_t>(at), next = std::min(k + 1, values.size() - 1);
        out << "p" << std::setprecision(p == 99.9 ? 1 : 0) << p << std::setprecision(2) << " "
            << values[k] + (at - k) * (values[next] - values[k]) << " ms, ";
    }
    out << "max " << values.back() << " ms";
    return out.str();
}

void run(const Options& o) {
    Controller c(o.controller);
    const double period = o.rate > 0 ? 1.0 / o.rate : c.period;
    const double deadline = o.deadline > 0 ? 1e-3 * o.deadline : 0.8 * period;
    std::cout << o.controller << ": " << c.about << "\n";
    Series reference = read_csv(o.reference, c.state_names), log;
    std::unique_ptr<Receiver> udp;
    if (o.udp) udp = std::make_unique<Receiver>(o.udp, c.sizes.nx);
    else log = read_csv(o.log, c.state_names);
    const double begin = o.udp ? 0.0 : log.t.front();
    const int periods = static_cast<int>((o.udp ? o.seconds : std::min(o.seconds > 0 ? o.seconds : 1e9, log.t.back() - begin)) / period);
    const bool realtime = o.realtime || o.udp;

    std::ofstream out;
    if (!o.out.empty()) {
        out.open(o.out);
        if (!out) throw std::runtime_error(o.out + " cannot be written");
        out << "t";
        for (const auto& name : c.input_names) out << "," << name;
        out << ",rate_x,rate_y,rate_z,thrust,source,status,iterations,solve_ms\n" << std::setprecision(9);
    }

    // commands on their way: what acts from a measurement until the next command does
    const int ahead = static_cast<int>(std::lround(c.latency / c.sample)), every = static_cast<int>(std::lround(period / c.sample));
    std::vector<Numbers> commands(std::max(ahead, 1), c.hover);
    Numbers state(c.sizes.nx, std::nan("")), window(c.sizes.steps * c.sizes.nx), solves, gaps;
    for (int k = 0; k < 3; ++k) {  // the first calls allocate: before the flight, not in it
        Numbers still(c.sizes.nx, 0.0);
        still[6] = 1.0;
        for (int i = 0; i < c.sizes.steps; ++i) std::copy(still.begin(), still.end(), window.begin() + i * c.sizes.nx);
        c.step(still, true, 0.0, window, c.hover, {});
        if (c.sizes.nz == c.sizes.nx) c.predict(still, c.hover);
    }
    Solver solver(c);
    std::optional<Result> newest;
    std::map<std::string, int> sources, statuses;
    const auto started = Clock::now();
    auto before = started;
    for (int k = 0; k < periods; ++k) {
        const double now = k * period;
        if (realtime) {
            std::this_thread::sleep_until(started + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(now)));
            auto woke = Clock::now();
            if (k > 0) gaps.push_back(std::chrono::duration<double, std::milli>(woke - before).count());
            before = woke;
        }
        const auto tick = Clock::now();
        Job job;
        if (udp) job.valid = udp->newest(state);
        else if (const Numbers* row = log.newest(begin + now)) state = *row;
        job.state = state;
        if (c.sizes.nz == c.sizes.nx)
            for (int i = 0; i < ahead; ++i) job.state = c.predict(job.state, commands[i]);
        const double at = o.start + begin + now + ahead * c.sample;
        for (int i = 0; i < c.sizes.steps; ++i) {
            Numbers row = reference.at(at + (i + 1) * c.dt);
            std::copy(row.begin(), row.end(), window.begin() + i * c.sizes.nx);
        }
        job.reference = window;
        job.last = commands.back();
        job.time = now;
        job.hold = k == o.late;
        solver.give(job);  // not taken while the one before is not done
        std::optional<Clock::time_point> until;
        if (realtime || k == o.late) until = tick + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(deadline));
        if (auto result = solver.wait(until)) {
            solves.push_back(result->milliseconds);
            newest = std::move(result);
        }

        Numbers inputs = c.hover, rates(3, 0.0);
        double thrust = 0.0;
        for (double u : c.hover) thrust += u / c.hover.size();
        std::string source = "hover", status = "none";
        int iterations = 0;
        const double age = newest ? now - newest->time : 1e9;
        if (newest && age <= c.keep) {
            const Plan& plan = newest->plan;
            const int step = std::min(static_cast<int>(age / c.dt), c.sizes.steps - 1);
            inputs.assign(plan.inputs.begin() + step * c.sizes.nu, plan.inputs.begin() + (step + 1) * c.sizes.nu);
            rates = plan.rates;
            thrust = plan.thrust;
            status = c.status[plan.status];
            iterations = plan.iterations;
            source = age > 1e-9 ? "late" : status.find(':') == std::string::npos ? "plan" : status.substr(status.find(':') + 1);
        }
        bool sound = true;
        for (double u : inputs) sound = sound && u >= 0.0 && u <= 1.0;
        if (!sound) {  // never seen; what leaves is looked at all the same
            inputs = c.hover;
            source = "hover";
        }
        ++sources[source];
        ++statuses[status];
        for (int i = 0; i < every && !commands.empty(); ++i) {
            commands.erase(commands.begin());
            commands.push_back(inputs);
        }
        if (udp && !o.reply.empty()) udp->send(o.reply, inputs);
        if (out) {
            out << begin + now;
            for (double u : inputs) out << "," << u;
            for (double w : rates) out << "," << w;
            out << "," << thrust << "," << source << "," << status << "," << iterations << "," << (solves.empty() ? 0.0 : solves.back()) << "\n";
        }
    }
    rusage usage{};
    getrusage(RUSAGE_SELF, &usage);
    std::cout << periods << " periods of " << 1e3 * period << " ms; commands from:";
    for (const auto& [name, count] : sources) std::cout << " " << name << " " << count;
    std::cout << "; status:";
    for (const auto& [name, count] : statuses) std::cout << " " << name << " " << count;
    std::cout << "\nsolves: " << percentiles(solves) << "\n";
    if (realtime) std::cout << "periods: " << percentiles(gaps) << "\n";
    std::cout << "memory: " << usage.ru_maxrss / 1024 << " MB\n";
}

}  // namespace

int main(int count, char** words) {
    try {
        run(parsed(count, words));
    } catch (const std::exception& error) {
        std::cerr << "flight_computer: " << error.what() << "\n";
        return 2;
    }
    return 0;
}
