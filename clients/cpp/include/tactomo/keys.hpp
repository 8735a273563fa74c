// Keys for a daemon beyond this computer: who this client is, and which server it expects.
//
// CURVE, as ZeroMQ has it; clients/STREAM.md, "Beyond the machine", has all of it, and `tactomo keys`
// makes the files. An ipc:// address needs no keys, the file's mode guards it.
#pragma once

#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <string>
#include <string_view>
#include <vector>
#include <zmq.hpp>

#include "error.hpp"

namespace tactomo {

/// A client's pair of keys and its server's public key, each 40 characters of Z85.
struct Keys {
    std::string public_key;
    std::string secret_key;
    std::string server_key;

    /// Reads a folder that holds one NAME.key_secret of your own and the server's NAME.key; your own
    /// NAME.key may lie there, too. Throws KeysError where one is missing, there are several, a file
    /// holds no key, or others may read the secret one.
    static Keys load(const std::filesystem::path& folder);
};

namespace detail {

inline constexpr std::size_t key_characters = 40;

inline bool is_key(const std::string& key) {
    constexpr std::string_view others = ".-:+=^!/*?&<>()[]{}@%$#";
    if (key.size() != key_characters) return false;
    for (const char c : key) {
        const bool is_alphanumeric =
            (c >= '0' && c <= '9') || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
        if (!is_alphanumeric && others.find(c) == std::string_view::npos) return false;
    }
    return true;
}

/// The key after `name =` in a file of keys, quoted or not; empty where there is none.
inline std::string read_key(const std::filesystem::path& path, std::string_view name) {
    std::ifstream file(path);
    for (std::string line; std::getline(file, line);) {
        const std::size_t begin = line.find_first_not_of(" \t");
        if (begin == std::string::npos || line.compare(begin, name.size(), name) != 0) continue;
        const std::size_t equals = line.find('=', begin);
        const std::size_t first = line.find_first_not_of(" \t\"'", equals + 1);
        if (equals == std::string::npos || first == std::string::npos) return {};
        return line.substr(first, line.find_last_not_of(" \t\"'\r") + 1 - first);
    }
    return {};
}

inline std::string require_key(const std::filesystem::path& path, std::string_view name) {
    std::string key = read_key(path, name);
    if (!is_key(key)) {
        throw KeysError(path.string() + " holds no " + std::string(name) + " of 40 characters",
                        "copy it once more, or make keys with `tactomo keys make NAME`");
    }
    return key;
}

/// The files of a folder that end so, other than the one of this stem.
inline std::vector<std::filesystem::path> files_of(const std::filesystem::path& folder,
                                                   std::string_view suffix,
                                                   const std::filesystem::path& but = {}) {
    std::vector<std::filesystem::path> found;
    std::error_code none;
    for (const auto& entry : std::filesystem::directory_iterator(folder, none)) {
        const std::filesystem::path& path = entry.path();
        if (path.extension() == suffix && path.stem() != but) found.push_back(path);
    }
    return found;
}

inline std::filesystem::path only(const std::filesystem::path& folder,
                                  const std::vector<std::filesystem::path>& found,
                                  const std::string& what) {
    if (found.size() == 1) return found.front();
    throw KeysError(folder.string() + " should hold one " + what + ", and holds " +
                        std::to_string(found.size()),
                    "keep a folder for each server, with your own NAME.key_secret and the server's "
                    "NAME.key");
}

/// Whether systemd holds the file for this service (LoadCredential=), guarded by its own means.
inline bool is_credential(const std::filesystem::path& path) {
    const char* const folder = std::getenv("CREDENTIALS_DIRECTORY");
    if (folder == nullptr) return false;
    const std::filesystem::path inside = std::filesystem::weakly_canonical(path).lexically_relative(
        std::filesystem::weakly_canonical(folder));
    return !inside.empty() && *inside.begin() != "..";
}

inline void refuse_if_others_read(const std::filesystem::path& path) {
    using std::filesystem::perms;
    const perms open = std::filesystem::status(path).permissions() & (perms::group_all | perms::others_all);
    if (open == perms::none || is_credential(path)) return;
    throw KeysError("users other than the owner may read " + path.string(),
                    "if nobody has copied the key: chmod 600 " + path.string() +
                        "; otherwise make new keys");
}

/// `~/keys` as a shell would read it.
inline std::filesystem::path from_home(const std::filesystem::path& path) {
    const char* const home = std::getenv("HOME");
    if (home == nullptr || path.empty() || *path.begin() != "~") return path;
    return home / path.lexically_relative("~");
}

/// Has a client's socket use these keys, unless the address is one of this computer's files.
inline void secure(zmq::socket_t& socket, const std::string& address, const Keys& keys) {
    if (keys.secret_key.empty() || address.compare(0, 6, "ipc://") == 0) return;
    for (const std::string* key : {&keys.public_key, &keys.secret_key, &keys.server_key}) {
        if (!is_key(*key)) throw KeysError("a key has 40 characters", "copy it once more");
    }
    socket.set(zmq::sockopt::curve_publickey, keys.public_key);
    socket.set(zmq::sockopt::curve_secretkey, keys.secret_key);
    socket.set(zmq::sockopt::curve_serverkey, keys.server_key);
}

}  // namespace detail

inline Keys Keys::load(const std::filesystem::path& folder) {
    const std::filesystem::path where = detail::from_home(folder);
    const std::filesystem::path mine =
        detail::only(where, detail::files_of(where, ".key_secret"), "secret key of your own");
    const std::filesystem::path theirs = detail::only(
        where, detail::files_of(where, ".key", mine.stem()), "server's public key");
    detail::refuse_if_others_read(mine);
    return {detail::require_key(mine, "public-key"), detail::require_key(mine, "secret-key"),
            detail::require_key(theirs, "public-key")};
}

/// What became of a client's handshakes: a closed door is not the same as nobody at home.
enum class Door {
    open,          ///< let in, or nobody has answered yet
    key_refused,   ///< the server does not let this client's key in: `tactomo keys allow` does
    keys_needed,   ///< the server hangs up on a client without keys
    wrong_server,  ///< not the server of that public key, or it uses no keys
};

namespace detail {

/// Watches a socket's handshakes. Belongs to the socket's thread; destroy it before the socket.
class Handshakes : public zmq::monitor_t {
public:
    Handshakes(zmq::socket_t& socket, bool has_keys) : has_keys_(has_keys) {
        // Unique within the socket's own context.
        const auto name = std::to_string(reinterpret_cast<std::uintptr_t>(socket.handle()));
        init(socket, "inproc://tactomo-handshakes-" + name,
             ZMQ_EVENT_CONNECTED | ZMQ_EVENT_DISCONNECTED | ZMQ_EVENT_HANDSHAKE_SUCCEEDED |
                 ZMQ_EVENT_HANDSHAKE_FAILED_AUTH | ZMQ_EVENT_HANDSHAKE_FAILED_PROTOCOL |
                 ZMQ_EVENT_HANDSHAKE_FAILED_NO_DETAIL);
    }

    /// Takes note of what has happened.
    Door look() {
        try {
            while (check_event(0)) {
            }
        } catch (const zmq::error_t&) {  // a signal; what is left is seen the next time
        }
        // One connection may have been cut in the middle of a handshake: the server was stopped.
        if (failures_ == 0 || (failures_ == 1 && is_vague_)) return Door::open;
        if (is_auth_ && has_keys_) return Door::key_refused;
        return has_keys_ ? Door::wrong_server : Door::keys_needed;
    }

    /// Whether something listens at the other end, busy or not, as of the last look().
    bool is_connected() const noexcept { return is_connected_; }

    void on_event_connected(const zmq_event_t&, const char*) override { is_connected_ = true; }
    void on_event_disconnected(const zmq_event_t&, const char*) override { is_connected_ = false; }
    void on_event_handshake_succeeded(const zmq_event_t&, const char*) override { failures_ = 0; }
    void on_event_handshake_failed_auth(const zmq_event_t&, const char*) override {
        note(true, false);
    }
    void on_event_handshake_failed_protocol(const zmq_event_t&, const char*) override {
        note(false, false);
    }
    void on_event_handshake_failed_no_detail(const zmq_event_t&, const char*) override {
        note(false, true);
    }

private:
    void note(bool is_auth, bool is_vague) noexcept {
        ++failures_;
        is_auth_ = is_auth;
        is_vague_ = is_vague;
    }

    bool has_keys_;
    unsigned failures_ = 0;  // since the last success
    bool is_auth_ = false;
    bool is_vague_ = false;
    bool is_connected_ = false;
};

}  // namespace detail
}  // namespace tactomo
