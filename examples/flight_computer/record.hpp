// What an exported file says of itself (extra/nsde.json): a JSON reader of just what is needed, and SHA-256.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

struct Json {
    enum Kind { Null, Bool, Number, String, Array, Object } kind = Null;
    double number = 0.0;
    std::string text;
    std::vector<Json> items;
    std::map<std::string, Json> members;

    // The member of that name; throws if there is none.
    const Json& at(const std::string& name) const;
};

// Throws std::runtime_error on anything that is no JSON.
Json parse_json(const std::string& text);

class Sha256 {
public:
    void add(const void* data, size_t size);
    std::string hex();

private:
    void block(const uint8_t* data);
    std::array<uint32_t, 8> state_{0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                                   0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    std::array<uint8_t, 64> rest_{};
    uint64_t size_ = 0;
};
