#include "series.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <limits>
#include <sstream>
#include <stdexcept>

namespace {

std::vector<std::string> fields(const std::string& line) {
    std::vector<std::string> out;
    std::stringstream stream(line);
    for (std::string field; std::getline(stream, field, ',');) {
        while (!field.empty() && (field.back() == '\r' || field.back() == ' ')) field.pop_back();
        out.push_back(field);
    }
    return out;
}

double number(const std::string& field) {
    char* after = nullptr;
    double value = std::strtod(field.c_str(), &after);
    return after == field.c_str() ? std::numeric_limits<double>::quiet_NaN() : value;
}

}  // namespace

Series read_csv(const std::string& file, const std::vector<std::string>& names) {
    std::ifstream stream(file);
    std::string line;
    if (!stream || !std::getline(stream, line)) throw std::runtime_error(file + " cannot be read");
    auto header = fields(line);
    std::vector<size_t> columns;
    std::vector<std::string> wanted{"t"};
    wanted.insert(wanted.end(), names.begin(), names.end());
    for (const auto& name : wanted) {
        auto found = std::find(header.begin(), header.end(), name);
        if (found == header.end()) throw std::runtime_error(file + " has no column " + name);
        columns.push_back(found - header.begin());
    }
    Series out;
    while (std::getline(stream, line)) {
        auto values = fields(line);
        if (values.empty()) continue;
        values.resize(header.size());
        double t = number(values[columns[0]]);
        if (!std::isfinite(t) || (!out.t.empty() && t <= out.t.back())) continue;  // a row of no time is of no use
        out.t.push_back(t);
        auto& row = out.rows.emplace_back();
        for (size_t k = 1; k < columns.size(); ++k) row.push_back(number(values[columns[k]]));
    }
    if (out.t.empty()) throw std::runtime_error(file + " holds no rows");
    return out;
}

const std::vector<double>* Series::newest(double time) const {
    auto after = std::upper_bound(t.begin(), t.end(), time + 1e-9);
    return after == t.begin() ? nullptr : &rows[after - t.begin() - 1];
}

std::vector<double> Series::at(double time) const {
    auto after = std::upper_bound(t.begin(), t.end(), time);
    if (after == t.begin()) return rows.front();
    if (after == t.end()) return rows.back();
    size_t k = after - t.begin();
    double share = (time - t[k - 1]) / (t[k] - t[k - 1]);
    std::vector<double> out(rows[k]);
    for (size_t i = 0; i < out.size(); ++i) out[i] = (1.0 - share) * rows[k - 1][i] + share * rows[k][i];
    if (out.size() >= 10) {
        double norm = std::sqrt(out[6] * out[6] + out[7] * out[7] + out[8] * out[8] + out[9] * out[9]);
        for (int i = 6; i < 10; ++i) out[i] /= std::max(norm, 1e-12);
    }
    return out;
}
