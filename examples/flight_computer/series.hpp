// Tables of numbers over time: a recorded flight, or a reference.
#pragma once

#include <string>
#include <vector>

struct Series {
    std::vector<double> t;
    std::vector<std::vector<double>> rows;

    // The newest row at or before a time; null before the first.
    const std::vector<double>* newest(double time) const;
    // The row at a time, between two of them by interpolation, the ends held; a quaternion in columns 6 to 9 is normalised.
    std::vector<double> at(double time) const;
};

// Columns `t` and `names` of a CSV file with a header; an empty field or `nan` is not a number. Throws on what is missing.
Series read_csv(const std::string& file, const std::vector<std::string>& names);
