// What a message's fields are made of: text and images that keep their storage.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <string_view>
#include <vector>

namespace tactomo {

/// A string of at most N bytes, kept in place; what is longer is cut.
template <std::size_t N>
class Text {
public:
    Text& operator=(std::string_view text) noexcept {
        size_ = std::min(text.size(), N);
        // Never through the middle of a character.
        while (size_ < text.size() && size_ > 0 && (text[size_] & 0xC0) == 0x80) --size_;
        std::copy_n(text.data(), size_, bytes_.data());
        return *this;
    }

    std::string_view view() const noexcept { return {bytes_.data(), size_}; }
    operator std::string_view() const noexcept { return view(); }
    bool empty() const noexcept { return size_ == 0; }

    friend bool operator==(const Text& a, const Text& b) noexcept { return a.view() == b.view(); }
    friend bool operator!=(const Text& a, const Text& b) noexcept { return !(a == b); }
    friend bool operator==(const Text& a, std::string_view b) noexcept { return a.view() == b; }
    friend bool operator!=(const Text& a, std::string_view b) noexcept { return !(a == b); }

private:
    std::array<char, N> bytes_{};
    std::size_t size_ = 0;
};

/// Values at the nodes of an even grid, row by row from the bottom; false where there are none.
class Image {
public:
    explicit operator bool() const noexcept { return known_; }
    std::size_t rows() const noexcept { return rows_; }
    std::size_t columns() const noexcept { return columns_; }
    /// rows() × columns() values, for Eigen::Map, cv::Mat and the like.
    const float* data() const noexcept { return values_.data(); }
    /// The value at node iy from the bottom and ix from the left; NaN: a node without a value.
    float operator()(std::size_t iy, std::size_t ix) const noexcept {
        return values_[iy * columns_ + ix];
    }

    void clear() noexcept {
        known_ = false;
        rows_ = columns_ = 0;
    }
    /// Make it rows × columns and return where the values go.
    float* reshape(std::size_t rows, std::size_t columns) {
        values_.resize(rows * columns);
        rows_ = rows;
        columns_ = columns;
        known_ = true;
        return values_.data();
    }

private:
    std::vector<float> values_;
    std::size_t rows_ = 0;
    std::size_t columns_ = 0;
    bool known_ = false;
};

}  // namespace tactomo
