// Prints each final verdict of a running daemon:
//   g++ -std=c++17 examples/cpp/subscribe.cpp -o subscribe && ./subscribe /run/hardnessd/events.sock
#include <cstdio>
#include <cstring>
#include <iostream>
#include <string>
#include <sys/socket.h>
#include <sys/un.h>

// The text of a value. A program that reads more takes a JSON library, such as nlohmann/json.
std::string value(const std::string &event, const std::string &key) {
    const auto at = event.find("\"" + key + "\":");
    if (at == std::string::npos) return "";
    const auto begin = at + key.size() + 3;
    return event.substr(begin, event.find_first_of(",}", begin) - begin);
}

int main(int count, char **arguments) {
    if (count != 2) return std::cerr << "found " << count - 1 << " arguments, expected the path of a socket" << std::endl, 2;
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    std::strncpy(address.sun_path, arguments[1], sizeof(address.sun_path) - 1);
    const int daemon = socket(AF_UNIX, SOCK_STREAM, 0);
    if (connect(daemon, reinterpret_cast<sockaddr *>(&address), sizeof(address)) != 0) return std::perror(arguments[1]), 1;
    FILE *lines = fdopen(daemon, "r");
    char *line = nullptr;
    for (size_t room = 0; getline(&line, &room, lines) > 0;) {
        const std::string event = line;
        if (value(event, "phase") == "\"final\"")
            std::cout << value(event, "label") << " " << value(event, "confidence") << " " << value(event, "force_n") << std::endl;
    }
}
